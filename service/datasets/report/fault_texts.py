"""Sentences of a report: faults of the torque and of its columns, and their corrections."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from service.datasets.report.texts import list_names


def with_options(fault: str, options: Mapping[str, str], only_if: str | None) -> str:
    """Add the options that correct a fault, as the API names them; `service.cli.wording` has those of the shell."""
    start = "Read" if only_if is None else f"If {only_if}, read"
    listed = " ".join(f"{name}={value}" for name, value in options.items())
    return f"{fault} {start} the file again with `{listed}`."


def energy_loss(watts: float) -> str:
    """Report torques that brake the motion. watts: mean power that they take."""
    return (
        f"The torques take {watts:.2g} W from the motion on average, as if friction drove the arm. "
        "Is the sign of all or some torques inverted, or is the torque ahead of the motion in time?"
    )


def negative_friction(joints: Sequence[str]) -> str:
    """Report negative friction."""
    return (
        f"The friction of {list_names(joints)} is negative: it would drive the joint. Possible causes: an inverted "
        "torque sign, torque recorded earlier than its motion, or derivatives that were filtered too much."
    )


def torque_order(robot: str, moved: Iterable[tuple[str, str]]) -> str:
    """Report torque columns in another order. moved: (joint, joint with its torque in the column)."""
    pairs = list_names([f"the torque read for {read} belongs to {joint}" for joint, read in moved])
    return f"The torque columns are in another order than the positions, by the torque that {robot} needs: {pairs}."


def joint_order(robot: str, moved: Iterable[tuple[str, str]]) -> str:
    """Report joints in another order. moved: (joint of the data, joint of the robot)."""
    pairs = list_names([f"{name} is {actual}" for name, actual in moved])
    return f"The joints are in another order than those of {robot}, by the torque that it needs: {pairs}."


def opposite_sign(joints: Sequence[str], robot: str) -> str:
    """Report inverted torque."""
    return f"The torque of {list_names(joints)} has the opposite sign of the torque that {robot} needs."


def unexpected_gravity(joints: Sequence[str], factors: Iterable[float], robot: str) -> str:
    """Report gravity in torque that should lack it. factors: gravity of each joint, times that of the robot."""
    return (
        f"The torque of {list_names(joints)} contains gravity {_times(factors, robot)} but was read as without gravity."
    )


def missing_gravity(joints: Sequence[str], factors: Iterable[float], robot: str) -> str:
    """Report torque without gravity. factors: gravity of each joint, times that of the robot."""
    return f"The torque of {list_names(joints)} lacks gravity {_times(factors, robot)}."


def doubled_gravity(joints: Sequence[str], factors: Iterable[float], robot: str, inertia: float | None) -> str:
    """Report gravity that was added twice. factors, inertia: gravity by joint and median inertia, times the robot's."""
    other = "inertia is not visible" if inertia is None else f"inertia {inertia:.2g} times"
    return (
        f"The torque of {list_names(joints)} contains gravity twice "
        f"({_numbers(factors)} times that of {robot}, {other}). "
        "Gravity is added to a torque that already contains it. Record that torque without the addition."
    )


def upward_gravity(joints: Sequence[str], factors: Iterable[float], robot: str) -> str:
    """Report gravity upwards. factors: gravity of each joint, times that of the robot."""
    return (
        f"The torque of {list_names(joints)} has gravity upwards {_times(factors, robot)}. "
        f"Does the robot hang upside down? {_MOUNTING}"
    )


def tilted_gravity(joints: Sequence[str], robot: str, angle: float) -> str:
    """Report gravity in another direction than the URDF's. joints: those with visible gravity; angle: degrees."""
    return (
        f"The torque of {list_names(joints)} has gravity in another direction than the base of {robot}, about "
        f"{angle:.0f}° away. Is the robot on a wall, or tilted? {_MOUNTING}"
    )


_MOUNTING = "Training tries other positions of the base. A URDF with the base as mounted is better."


def torque_scale(joints: Sequence[str], factors: Iterable[float], robot: str) -> str:
    """Report torque that is too large or too small. factors: gravity of each joint, times that of the robot."""
    return (
        f"The torque of {list_names(joints)} is {_numbers(factors)} times the torque that {robot} needs. "
        "Is it motor current, torque before a gear, in another unit, or from another robot? "
        "If it is motor current, upload the file with the manufacturer's torque constants."
    )


def _times(factors: Iterable[float], robot: str) -> str:
    return f"({_numbers(factors)} times that of {robot})"


def _numbers(values: Iterable[float]) -> str:
    return list_names([f"{value:.2g}" for value in values])

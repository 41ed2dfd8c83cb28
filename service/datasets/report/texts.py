"""Sentences of a report: warnings, faults and their corrections, advice, notes, reasons and the summary."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from service.foundation.text import percent

MAX_LISTED, MAX_SPANS = 8, 3
"""Max names, and max stretches of time, that a sentence lists."""


def list_names(names: Iterable[str]) -> str:
    """Join names for a sentence; of many, only the first `MAX_LISTED`."""
    parts = list(names)
    if len(parts) > MAX_LISTED:
        parts = [*parts[:MAX_LISTED], f"{len(parts) - MAX_LISTED} more"]
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


# Warnings


def uneven_times(jitter: float) -> str:
    """Warn of uneven time stamps. jitter: 99 % quantile of a step's relative deviation."""
    return (
        f"Time stamps are uneven: 1 % of the time steps deviate by more than {percent(jitter)} from the median step. "
        "Record the time stamps of the robot's own clock, not the time of reception."
    )


def missing_values(missing: int, rows: int) -> str:
    """Warn of rows that lack a value."""
    return f"{missing} of {rows} rows lack a value and were dropped."


def closed_brakes(joints: Sequence[str], share: float, spans: Sequence[tuple[float, float]]) -> str:
    """Warn of rows with closed brakes. spans: first and last time of each stretch, s from the start."""
    shown = [f"{first:.1f} s to {last:.1f} s" for first, last in spans[:MAX_SPANS]]
    more = [f"{len(spans) - MAX_SPANS} more"] if len(spans) > MAX_SPANS else []
    return (
        f"{list_names(joints)}: no torque at standstill in {percent(share)} of the rows "
        f"({list_names(shown + more)} after the start), although gravity needs torque there. The brakes were probably "
        "closed. These rows were left out, because a model must not be trained on them. Record only while the drives "
        "hold the arm."
    )


def beyond_limits(quantities: str, shares: Mapping[str, float]) -> str:
    """Warn of samples beyond limits. shares: share of such samples, by joint."""
    return (
        f"{quantities} of {list_names(shares)} exceed the robot's limits, in up to {percent(max(shares.values()), 1)} "
        "of the samples. Check the robot, the order of the joints and the units."
    )


def clipped_torque(joints: Sequence[str]) -> str:
    """Warn of torque with flat tops."""
    return f"The torque of {list_names(joints)} was clipped: it stays at its extreme value while the joint moves."


def torque_at_limit(joints: Sequence[str]) -> str:
    """Warn of torque at the robot's limit."""
    return (
        f"The torque of {list_names(joints)} reaches the robot's limit. "
        "The commanded torque may not have been applied in full."
    )


def common_lag(seconds: float, std_s: float, cost: float) -> str:
    """Warn of a lag of all joints. cost: largest share of a joint's torque variance that becomes error."""
    return (
        f"Torque and motion are not synchronised: torque {_lags(seconds)} motion by {1e3 * abs(seconds):.1f} ms "
        f"(± {1e3 * std_s:.1f}). Up to {percent(cost, 1)} of a joint's torque variance becomes error. "
        "Record all signals with one clock and the same filter."
    )


def lag_of_one_joint(joint: str | None, seconds: float, std_s: float) -> str:
    """Warn of a lag that other joints do not have."""
    return (
        f"The torque of {joint} {_lags(seconds)} its motion by {1e3 * abs(seconds):.0f} ms (± {1e3 * std_s:.0f}). "
        "Other joints have no such lag, so time stamps do not explain it. A filter on this joint may, or friction that "
        "depends on more than speed."
    )


def _lags(seconds: float) -> str:
    return "lags" if seconds > 0 else "leads"


# Faults and their corrections


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


# The robot


def matching_robots(candidates: Sequence[str], best: str | None) -> str:
    """Suggest robots with such joint names. best: the one to compare with, None if undecided."""
    match = f"The joint names match {list_names(candidates)}"
    if best is None:
        return f"{match}. Name the robot with `--robot` to check limits and torque."
    which = f"{match}, and the torque fits {best}" if len(candidates) > 1 else match
    return f"{which}. With this robot, limits and torque can be checked."


def unknown_robot(examples: Sequence[str]) -> str:
    """Ask for the robot's name. examples: robots with as many joints."""
    return (
        "No robot is named, and the joint names match none. If it is one of `lipserve robots list` "
        f"(with as many joints: {list_names(examples)}), read the file again with `robot` "
        "to check friction, limits and torque."
    )


def better_robot(named: str, factor: float, other: str, other_factor: float) -> str:
    """Report that another robot fits. factor, other_factor: gravity in the torque, times that of each robot."""
    return (
        f"Gravity in the torque is {factor:.2g} times that of {named}, but {other_factor:.2g} times that of {other}, "
        "which the joint names match as well."
    )


# Advice


def advice_for(joints: Iterable[str], need: str) -> str:
    """Put the joints before a piece of advice. Pages show them as marks."""
    return f"{list_names(joints)}: {need}"


def still_joint(span: float) -> str:
    """Advise on joints that moved less than a span in rad or m."""
    return f"moved less than {span:g} rad or m. Move the joint, or leave it out with `drop_joints`."


ONE_DIRECTION = "moved in one direction only. Record motion in both directions to determine Coulomb friction."


def little_slow_motion(speed: float) -> str:
    """Advise on missing motion below a speed in rad/s or m/s."""
    return (
        f"too little motion below {speed:g} rad/s (m/s) in at least one direction. "
        "Record slow motion in both directions to determine Coulomb friction."
    )


UNDETERMINED_FRICTION = (
    "viscous or Coulomb friction is not determined. Record longer, at several speeds in both directions."
)
UNDETERMINED_OFFSET = "a constant torque cannot be separated from gravity. Move the joint through more of its range."
SMALL_RANGE = (
    "moved through a small part of its range. Move it further: elsewhere, gravity and inertia are extrapolated."
)


def slow_joint(share: float) -> str:
    """Advise on joints below a share of their speed limit."""
    return f"stayed below {percent(share)} of its speed limit. Record faster motion if the model needs it."


REGULAR_MOTION = (
    "motion is too regular: one of velocity, its sign, acceleration and gravity follows from the others. Record motion "
    "with several frequencies and amplitudes."
)


def noisy_torque(share: float) -> str:
    """Advise on noise above a share of the torque's standard deviation."""
    return (
        f"noise exceeds {percent(share)} of the torque's standard deviation. "
        "Record longer, with larger or faster motion."
    )


SMOOTHED_TORQUE = (
    "torque was smoothed before recording, or simulated, so its noise cannot be estimated. Record raw torque, or at "
    "least torque as in the live stream."
)


def weak_excitation(weak: int, parameters: int, weakest_body: str) -> str:
    """Advise on base parameters that are hardly excited."""
    return (
        f"{weak} of {parameters} base parameters of the rigid bodies are hardly excited, least of all those of the "
        f"body that {weakest_body} moves. "
        "Record faster motion of all joints at once, or plan it with `lipserve excite`."
    )


def undetermined_gravity(robot: str) -> str:
    """Note that a recording does not show whether its torque contains gravity."""
    return (
        f"undetermined: whether the torque contains gravity, because the gravity of {robot} hardly changes in this "
        "recording"
    )


def held_poses(share: float) -> str:
    """Report a recording of held poses."""
    return (
        f"The robot stands still in {percent(share)} of the samples: they are held poses. They show gravity and "
        "stiction, but no friction and no inertia. In motion, a model answers with gravity and a large tau_std. Record "
        "motion, too."
    )


def one_moving_joint(joint: str) -> str:
    """Report a recording in which one joint moves."""
    return (
        f"Only {joint} moves. The torque of the other joints is learnt only near their positions, and without their "
        "friction. Move all joints, or keep one: `joints` names it."
    )


def too_short(seconds: float) -> str:
    """Report a recording that is too short to judge an error."""
    return (
        f"The recording lasts {seconds:.3g} s. A held-out part of it would say little about the error, so a version of "
        "it may not serve by itself. Record several minutes."
    )


def repeated_motion(period: float) -> str:
    """Advise on motion that repeats itself. period: s."""
    return (
        f"The motion repeats every {period:.3g} s. Errors on other motion may be larger than on held-out parts of it. "
        "Record other motion, too."
    )


def much_standstill(share: float) -> str:
    """Advise on standstill in a large share of the samples."""
    return (
        f"The robot stands still in {percent(share)} of the samples. "
        "These determine only gravity and stiction, at few positions. Record motion."
    )


def dependent_motion(dimensions: float, joints: int) -> str:
    """Advise on joints that move together. dimensions: number of independent motions."""
    return (
        f"The joints move together: {joints} joints make {dimensions:.1f} independent motions. Torque of other motion "
        "is extrapolated. Record motion in which each joint moves on its own, or plan it with `lipserve excite`."
    )


def short_recording(seconds: float) -> str:
    """Advise on a short recording."""
    return (
        f"The recording lasts {seconds:.3g} s. Record several minutes, so that a part can be held out for evaluation."
    )


# Notes on reading


def no_joint_matches(robot: str) -> str:
    """Note that the robot has none of the joints."""
    return f"no joint matches robot {robot}, so its limits were not compared"


def matched_by_order(robot: str) -> str:
    """Note that no joint name matches, so that joints were matched by order."""
    return f"joints were matched to robot {robot} by order, not by name"


def bodies_suggested(robot: str) -> str:
    """Note that friction is estimated with a suggested robot."""
    return f"friction is estimated beside the rigid bodies of {robot}, which the joint names match"


def bodies_incomplete(robot: str) -> str:
    """Note that the robot lacks some of the joints."""
    return f"some joints are not joints of robot {robot}, so its rigid bodies were not used"


def bodies_unusable(robot: str, why: object) -> str:
    """Note why a URDF cannot be used."""
    return f"the rigid bodies of robot {robot} were not used: {why}"


# Reasons for an unknown lag

CONSTANT_TORQUE = "the torque is constant"
NO_TIMES = "the recording has no times"
SHORT_PARTS = "the contiguous parts are too short"
NO_KNOWN_LAG = "no joint has a known lag"
ALL_SHIFTS_ALIKE = "all time shifts explain the torque about equally well: record faster motion"
NO_BEST_SHIFT = "no time shift is better than its neighbours: record faster motion"


def unexplained_torque(explained: float) -> str:
    """Return the reason for too small an explained share of the torque's variance."""
    return f"motion explains only {percent(explained)} of the torque"


def parts_differ(std_s: float) -> str:
    """Return the reason for too large a standard deviation of the lag."""
    return f"parts of the recording differ by {1e3 * std_s:.0f} ms: record faster motion"


# Summary


def friction_summary(term: str, joints_by_verdict: Mapping[str, Sequence[str]], n_joints: int) -> str:
    """Summarise how well one kind of friction is determined; verdicts as in `Verdict`."""
    parts = [
        f"{verdict}{'' if 'determined' in verdict else ' determined'} on "
        + ("all joints" if len(joints) == n_joints else list_names(joints))
        for verdict, joints in joints_by_verdict.items()
        if joints
    ]
    return f"{term}: {'; '.join(parts)}."


def bodies_summary(rank: int, parameters: int, condition: float | None, weakest: float) -> str:
    """Summarise the excitation of rigid bodies, see `WholeExcitation`."""
    how = "unknown" if condition is None else f"{condition:.3g}"
    return (
        f"{rank} of {parameters} base parameters of the rigid bodies are excited (condition number {how}). "
        f"The weakest reaches {weakest:.2g} times the excitation of random motion over the whole range."
    )

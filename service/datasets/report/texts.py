"""Sentences of a report: warnings, the robot, notes, reasons and the summary."""

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

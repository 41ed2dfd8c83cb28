"""One joint's signals: against what its robot can do, signs that its torque was cut off, and their white noise."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np

from lipcore.data.samples import Array
from lipcore.data.signals import DIFFERENCE_ORDERS
from lipcore.profiles import Profile
from lipcore.vocabulary import JointType
from service.datasets.report.timing import Rows
from service.datasets.schema import JointLimits, JointSaturation

AT_LIMIT = 0.99
"""Share of the torque limit from which on a torque counts as saturated."""
FLAT_ROWS = 5
"""Equal extreme torques in a row, while the joint moves, that are no chance."""
EXTREME = 1e-9
"""Share of the span that counts as equal to the largest value: rounding of a text file."""
NORMAL = 1.4826
"""Standard deviation of normal noise over the median of its size."""
MOST = 200_000
"""Differences that are enough for a median."""
SPREAD_SHARE = 0.1
"""Of the spread: what stands in where the parts are too short to tell, as in `noise_level`."""


@dataclass(frozen=True)
class Limits:
    """Limits of the recording's n joints, (n,) each, NaN where unknown, as of a joint that is none of the robot's.

    urdf_joints: what the profile calls these joints, None where one is not its; by_order: whether the joints were taken
    in the profile's order, as their names say nothing.
    """

    joint_types: tuple[JointType, ...]
    urdf_joints: tuple[str, ...] | None
    lower: Array
    upper: Array
    speed: Array
    torque: Array
    by_order: bool


def limits_of(profile: Profile | None, names: tuple[str, ...]) -> Limits | None:
    """Limits for a recording with these joints; None without a profile, or where none of its joints is among them."""
    if profile is None:
        return None
    matched = profile.match(names)
    by_order = all(joint is None for joint in matched) and len(names) == len(profile.joint_names)
    if by_order:
        matched = tuple(range(len(names)))
    known = [joint for joint in matched if joint is not None]
    if not known:
        return None
    places = [-1 if joint is None else joint for joint in matched]
    lower, upper, speed, torque = (
        np.append(np.where(np.isfinite(limit), limit, np.nan), np.nan)[places]
        for limit in (profile.lower, profile.upper, profile.speed, profile.torque)
    )
    bounded = upper > lower
    return Limits(
        tuple("revolute" if joint is None else profile.joint_types[joint] for joint in matched),
        tuple(profile.joint_names[joint] for joint in known) if len(known) == len(names) else None,
        np.where(bounded, lower, np.nan),
        np.where(bounded, upper, np.nan),
        np.where(speed > 0, speed, np.nan),
        np.where(torque > 0, torque, np.nan),
        by_order=by_order,
    )


def against_limits(joint: int, name: str, columns: dict[str, Array], limits: Limits | None) -> JointLimits:
    """Compare one joint's columns by quantity, values missing ones left out, with its robot's limits."""
    lower, upper, speed, torque = (
        (np.nan,) * 4
        if limits is None
        else tuple(float(each[joint]) for each in (limits.lower, limits.upper, limits.speed, limits.torque))
    )
    q, dq, tau = (columns.get(quantity, np.zeros(0)) for quantity in ("q", "dq", "tau"))
    range_used = beyond_range = None
    if np.isfinite(upper) and len(q):
        range_used = float(np.ptp(q)) / (upper - lower)
        beyond_range = float(np.mean((q < lower) | (q > upper)))
    speed_used, beyond_speed = _against(dq, speed)
    torque_used, beyond_torque = _against(tau, torque)
    return JointLimits(
        joint=name,
        range_used=range_used,
        speed_used=speed_used,
        torque_used=torque_used,
        beyond_range=beyond_range,
        beyond_speed=beyond_speed,
        beyond_torque=beyond_torque,
    )


def saturation(joint: int, name: str, q: Array, tau: Array, limits: Limits | None) -> JointSaturation:
    """Look for flat tops of one joint's torque; q, tau: (N,), values missing ones left out."""
    limit = np.nan if limits is None else float(limits.torque[joint])
    at_limit = float(np.mean(np.abs(tau) >= AT_LIMIT * limit)) if np.isfinite(limit) and len(tau) else None
    span = float(np.ptp(tau)) if len(tau) else 0.0
    if span == 0:
        return JointSaturation(joint=name, at_largest=0.0, flat=0.0, at_limit=at_limit)
    top, bottom = tau >= tau.max() - EXTREME * span, tau <= tau.min() + EXTREME * span
    # a robot that stands still holds its torque: only what stays equal while the position changes was cut off
    moved = np.concatenate([[True], np.diff(q) != 0])
    flat = _in_runs(top & moved) + _in_runs(bottom & moved)
    return JointSaturation(joint=name, at_largest=float(np.mean(top | bottom)), flat=flat / len(tau), at_limit=at_limit)


def _against(values: Array, limit: float) -> tuple[float | None, float | None]:
    """Largest magnitude over a limit, and the share beyond it; None where it is not known."""
    if not np.isfinite(limit) or len(values) == 0:
        return None, None
    size = np.abs(values)
    return float(size.max()) / limit, float(np.mean(size > limit))


def _in_runs(mask: np.ndarray) -> int:
    """Rows of a mask (N,) that are part of runs of FLAT_ROWS and more."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    lengths = edges[1::2] - edges[::2]
    return int(lengths[lengths >= FLAT_ROWS].sum())


def white_noise(values: Array, part: Rows, robust: bool = False) -> float | None:
    """Standard deviation of the white noise on smooth signals; None where the parts are too short to tell.

    values: (N,), missing ones NaN; part: number of the part of each row, ascending, (N,). A missing value has to be a
    part of its own. robust: by the median of the differences, so that jumps, as of Coulomb friction, count for nothing.
    """
    levels: list[float] = []
    difference = values
    for order in range(1, DIFFERENCE_ORDERS.stop):
        difference = np.diff(difference)
        if order not in DIFFERENCE_ORDERS or len(difference) == 0:
            continue
        within = difference[part[order:] == part[:-order]]
        if len(within) > 2 * order:
            levels.append(_size(within, robust) / comb(2 * order, order) ** 0.5)
    return min(levels) if levels else None


def _size(differences: Array, robust: bool) -> float:
    """Their root mean square, or what it would be by their median; coarse signals mostly have none that is not 0."""
    if robust:
        some = differences[:: max(1, len(differences) // MOST)]
        middle = NORMAL * float(np.median(np.abs(some)))
        if middle > 0:
            return middle
    return float(np.sqrt(np.dot(differences, differences) / len(differences)))


def noise_or_share(values: Array, part: Rows) -> float:
    """The same, a tenth of the spread where the parts are too short: equal to `noise_level`."""
    level = white_noise(values, part)
    return SPREAD_SHARE * float(values.std()) if level is None else level

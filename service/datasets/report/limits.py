"""One joint's signals against what its robot can do, and signs that its torque was cut off."""

from __future__ import annotations

import numpy as np

from lipcore.data.samples import Array
from service.datasets.report.robot import Limits
from service.datasets.report.schema import JointLimits, JointSaturation

AT_LIMIT = 0.99
"""Share of the torque limit from which on a torque counts as saturated."""
FLAT_ROWS = 5
"""Equal extreme torques in a row, while the joint moves, that are no chance."""
EXTREME = 1e-9
"""Share of the span that counts as equal to the largest value: rounding of a text file."""


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

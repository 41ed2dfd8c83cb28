"""Times of a recording, and signals of one joint: limits, saturation and white noise."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import spaced_rows
from lipcore.data.samples import Array
from lipcore.data.signals import DIFFERENCE_ORDERS
from lipcore.profiles import Profile
from lipcore.vocabulary import JointType
from service.contract.datasets import Gap, JointLimits, JointSaturation, Timing
from service.datasets.staging import EPISODE, TIME, Staged

Rows = NDArray[np.int64]


def number_parts(rows: int, breaks: list[NDArray[np.bool_]]) -> Rows:
    """Return the part of each row, numbered from 0, (rows,).

    breaks: (rows - 1,) each, true if a row does not follow the one before.
    """
    part = np.zeros(rows, np.int64)
    if rows > 1 and breaks:
        np.cumsum(np.logical_or.reduce(breaks), out=part[1:])
    return part


def bounds(part: Rows) -> tuple[Rows, Rows]:
    """Return the first row of each part and the row after its last one, (P,) each."""
    if len(part) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    changes = np.flatnonzero(np.diff(part)) + 1
    return np.concatenate([[0], changes]), np.concatenate([changes, [len(part)]])


def thin(part: Rows, max_rows: int, margin: int = 0) -> Rows:
    """Return at most `max_rows` rows, evenly spread, at least `margin` rows from both ends of their part."""
    starts, ends = bounds(part)
    starts, inner = starts + margin, np.maximum(0, ends - starts - 2 * margin)
    before = np.concatenate([[0], np.cumsum(inner)])
    total = int(before[-1])
    if total == 0:
        return np.zeros(0, np.int64)
    chosen = spaced_rows(total, max_rows)
    home = np.searchsorted(before, chosen, side="right") - 1
    return np.asarray(starts[home] + chosen - before[home], np.int64)


def finite_or_none(value: float | np.floating) -> float | None:
    """Return a number for JSON, None if it is infinite or NaN."""
    return float(value) if np.isfinite(value) else None


def spread(values: Array) -> float:
    """Return the standard deviation, 0 if there are no values."""
    return float(values.std()) if len(values) else 0.0


@dataclass(frozen=True)
class RecordedTimes:
    """Times of a raw recording.

    part: number of each row's contiguous part, (N,); missing: whether a row lacks a value, (N,).
    """

    timing: Timing
    part: Rows
    missing: NDArray[np.bool_]


def analyse_times(raw: Staged, gap_steps: float, repeated: int) -> RecordedTimes:
    """Analyse the times of a raw recording.

    gap_steps: a longer time step, in median steps, is a gap; repeated: time stamps dropped while reading.
    """
    missing = raw.missing()
    breaks = [missing[1:] | missing[:-1]]
    if EPISODE in raw:
        breaks.append(np.diff(raw.read(EPISODE)) != 0)
    if TIME not in raw:
        return RecordedTimes(_without_times(int(missing.sum())), number_parts(raw.rows, breaks), missing)
    t = raw.read(TIME)
    steps = np.diff(t)
    inside = ~np.logical_or.reduce(breaks) & np.isfinite(steps)
    inside &= steps > 0  # rows with a repeated time stamp are counted in `repeated`
    usual = float(np.median(steps[inside])) if inside.any() else 0.0
    if usual <= 0:
        return RecordedTimes(_without_times(int(missing.sum())), number_parts(raw.rows, breaks), missing)
    gap = inside & (steps > gap_steps * usual)
    even = inside & ~gap
    deviation = np.abs(steps[even] / usual - 1)
    middle, far = np.quantile(deviation, [0.5, 0.99]) if len(deviation) else (np.nan, np.nan)
    timing = Timing(
        rate_hz=1 / usual,
        duration_s=float(steps[even].sum()),
        jitter_p50=finite_or_none(middle),
        jitter_p99=finite_or_none(far),
        jitter_max=float(deviation.max()) if len(deviation) else None,
        gaps=_longest_gaps(t, steps, np.flatnonzero(gap)),
        repeated_stamps=repeated,
        missing_rows=int(missing.sum()),
    )
    return RecordedTimes(timing, number_parts(raw.rows, [*breaks, gap]), missing)


def _longest_gaps(t: Array, steps: Array, gaps: NDArray[np.intp]) -> list[Gap]:
    longest = np.sort(gaps[np.argsort(-steps[gaps], kind="stable")[:20]])
    return [Gap(t=float(t[row]), seconds=float(steps[row])) for row in longest]


def _without_times(missing: int) -> Timing:
    return Timing(
        rate_hz=None,
        duration_s=None,
        jitter_p50=None,
        jitter_p99=None,
        jitter_max=None,
        gaps=[],
        repeated_stamps=0,
        missing_rows=missing,
    )


@dataclass(frozen=True)
class SaturationOptions:
    """Thresholds of a saturated torque."""

    at_limit: float = 0.99
    """Share of the torque limit above which a torque counts as saturated."""
    min_run: int = 5
    """Min equal extreme torques in a row, while the joint moves, that count as clipped."""
    rounding: float = 1e-9
    """Difference from the largest value, as a share of the span, that counts as equal: rounding of a text file."""


SATURATION = SaturationOptions()


@dataclass(frozen=True)
class Limits:
    """Limits of the recording's n joints, (n,) each, NaN if unknown.

    urdf_joints: the profile's names of these joints, None if it lacks one; by_order: whether joints were matched by
    order, because no name matches.
    """

    joint_types: tuple[JointType, ...]
    urdf_joints: tuple[str, ...] | None
    lower: Array
    upper: Array
    speed: Array
    torque: Array
    by_order: bool


def limits_of(profile: Profile | None, names: tuple[str, ...]) -> Limits | None:
    """Return limits for a recording with these joints, None without a profile or without a joint that matches."""
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


def compare_with_limits(joint: int, name: str, columns: dict[str, Array], limits: Limits | None) -> JointLimits:
    """Compare one joint with its limits. columns: by quantity, without missing values."""
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
    speed_used, beyond_speed = _relate_to_limit(dq, speed)
    torque_used, beyond_torque = _relate_to_limit(tau, torque)
    return JointLimits(
        joint=name,
        range_used=range_used,
        speed_used=speed_used,
        torque_limit=torque if np.isfinite(torque) else None,
        torque_used=torque_used,
        beyond_range=beyond_range,
        beyond_speed=beyond_speed,
        beyond_torque=beyond_torque,
    )


def detect_saturation(joint: int, name: str, q: Array, tau: Array, limits: Limits | None) -> JointSaturation:
    """Detect flat tops of one joint's torque; q, tau: (N,), without missing values."""
    limit = np.nan if limits is None else float(limits.torque[joint])
    at_limit = float(np.mean(np.abs(tau) >= SATURATION.at_limit * limit)) if np.isfinite(limit) and len(tau) else None
    span = float(np.ptp(tau)) if len(tau) else 0.0
    if span == 0:
        return JointSaturation(joint=name, at_largest=0.0, flat=0.0, at_limit=at_limit)
    top, bottom = tau >= tau.max() - SATURATION.rounding * span, tau <= tau.min() + SATURATION.rounding * span
    # at rest, torque is constant anyway: only torque that stays equal while the position changes is clipped
    moved = np.concatenate([[True], np.diff(q) != 0])
    flat = _count_in_runs(top & moved) + _count_in_runs(bottom & moved)
    return JointSaturation(joint=name, at_largest=float(np.mean(top | bottom)), flat=flat / len(tau), at_limit=at_limit)


def _relate_to_limit(values: Array, limit: float) -> tuple[float | None, float | None]:
    """Return the largest magnitude divided by a limit, and the share beyond the limit; None if unknown."""
    if not np.isfinite(limit) or len(values) == 0:
        return None, None
    size = np.abs(values)
    return float(size.max()) / limit, float(np.mean(size > limit))


def _count_in_runs(mask: np.ndarray) -> int:
    """Count the rows of a mask (N,) in runs of at least SATURATION.min_run."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    lengths = edges[1::2] - edges[::2]
    return int(lengths[lengths >= SATURATION.min_run].sum())


def white_noise(values: Array, part: Rows, robust: bool = False) -> float | None:
    """Return the standard deviation of the white noise on smooth signals, None if the parts are too short.

    values: (N,), NaN if missing; part: part of each row, ascending, (N,); a missing value is a part of its own.
    robust: use the median of the differences, which jumps, as of Coulomb friction, do not affect.
    """
    levels: list[float] = []
    difference = values
    for order in range(1, DIFFERENCE_ORDERS.stop):
        difference = np.diff(difference)
        if order not in DIFFERENCE_ORDERS or len(difference) == 0:
            continue
        within = difference[part[order:] == part[:-order]]
        if len(within) > 2 * order:
            levels.append(_noise_level(within, robust) / comb(2 * order, order) ** 0.5)
    return min(levels) if levels else None


@dataclass(frozen=True)
class SmoothingOptions:
    """Thresholds of filtered torque noise, by the spectra of pieces of the signal."""

    rows: int = 128
    """Rows of a piece."""
    max_pieces: int = 200
    """Max pieces."""
    max_top: float = 0.02
    """Ratio of power at the top of the spectrum to that in its middle, below which the signal was filtered with at
    least two poles. White noise has 1; one pole, or jumps as of friction, have 0.2."""
    min_noise: float = 1e-6
    """Ratio of noise to the signal's standard deviation below which there is only rounding."""


SMOOTHING = SmoothingOptions()


def is_smoothed(values: Array, part: Rows, level: float | None) -> bool:
    """Return whether a torque's noise was filtered out before recording, so that its level means nothing.

    values: (N,), NaN if missing; part: as in `white_noise`; level: the result of `white_noise`.
    """
    wide = spread(values[np.isfinite(values)])
    if level is None or wide == 0:
        return False
    if level < SMOOTHING.min_noise * wide:
        return True
    starts, ends = bounds(part)
    firsts = np.concatenate(
        [np.arange(a, b - SMOOTHING.rows + 1, SMOOTHING.rows // 2) for a, b in zip(starts, ends, strict=True)]
    )
    if len(firsts) == 0:
        return False
    firsts = firsts[spaced_rows(len(firsts), SMOOTHING.max_pieces)]
    pieces = values[firsts[:, None] + np.arange(SMOOTHING.rows)]
    window = np.hanning(SMOOTHING.rows)
    power = np.median(np.abs(np.fft.rfft((pieces - pieces.mean(1, keepdims=True)) * window, axis=1)) ** 2, axis=0)
    middle, top = power[19:32], power[45:61]  # 0.15 to 0.25, and 0.35 to 0.48 of the sampling rate
    return bool(top.mean() < SMOOTHING.max_top * middle.mean())


def _noise_level(differences: Array, robust: bool) -> float:
    """Return the root mean square, or its estimate by the median unless that is 0, as of coarse signals."""
    if robust:
        some = differences[:: max(1, len(differences) // 200_000)]  # enough for a median
        middle = 1.4826 * float(np.median(np.abs(some)))  # the factor of normal noise
        if middle > 0:
            return middle
    return float(np.sqrt(np.dot(differences, differences) / len(differences)))


def noise_or_default(values: Array, part: Rows) -> float:
    """Return `white_noise`, or a tenth of the standard deviation if the parts are too short, as `noise_level` does."""
    level = white_noise(values, part)
    return 0.1 * float(values.std()) if level is None else level

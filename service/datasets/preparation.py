"""From checked columns to samples: what is missing is derived, and every step is said."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lipcore.samples import Array, Samples
from lipcore.signals import differentiate, low_pass, noise_level
from service.datasets.columns import Columns
from service.errors import invalid_data

MAX_RATE = 1e6
"""Hz; times that rise faster than this are not in seconds."""
GAP = 1.5
"""A time step longer than this many usual steps splits a recording."""
JITTER = 0.25
"""Largest deviation of a time step from the usual one that still counts as evenly sampled."""


@dataclass(frozen=True)
class Prepared:
    """Samples ready to learn from, and the report that tells how they came about."""

    samples: Samples
    report: dict[str, Any]


def prepare(columns: Columns, joint_names: tuple[str, ...], cutoff: float, min_samples: int) -> Prepared:
    """Derive missing velocities and accelerations as in the paper; raise InvalidDataError where that is not possible.

    Signals are low-passed without delay at `cutoff` Hz and differentiated acausally, one contiguous part at a time.
    """
    rows = len(columns.q)
    episode = np.zeros(rows, dtype=np.int64) if columns.episode is None else columns.episode
    times = columns.t
    t = np.arange(rows, dtype=np.float64) if times is None else times
    missing = [name for name in ("dq", "ddq") if getattr(columns, name) is None]
    steps: list[str] = []
    rate = None if times is None else _rate(t, episode)
    gaps = 0
    if rate is not None:
        episode, gaps = _split_at_gaps(t, episode, rate)
        if gaps:
            steps.append(f"split at {gaps} gaps in time")
    zeros = np.zeros_like(columns.q)
    given = Samples(
        joint_names,
        t,
        episode,
        columns.q,
        zeros if columns.dq is None else columns.dq,
        zeros if columns.ddq is None else columns.ddq,
        columns.tau,
    )
    samples = given
    if missing:
        if rate is None:
            raise invalid_data("t", "missing", f"times, since {' and '.join(missing)} must be derived")
        samples = _derive(given, missing, rate, cutoff, steps)
        if len(samples) < min_samples:
            raise invalid_data(
                "rows", len(samples), f"at least {min_samples} samples after trimming the filter's edges"
            )
    return Prepared(samples, _report(samples, rows, rate, gaps, missing, steps))


def _derive(given: Samples, missing: list[str], rate: float, cutoff: float, steps: list[str]) -> Samples:
    """Filter and differentiate; the filter's edges are cut off."""
    if cutoff >= rate / 2:
        raise invalid_data("cutoff", f"{cutoff:g} Hz", f"less than half the rate of {rate:g} Hz")
    edge = int(np.ceil(rate / cutoff))
    parts = []
    dropped = 0
    for part in given.episodes():
        one = given.rows(part)
        _check_even(one.t, rate, part.start)
        try:
            q, tau = low_pass(one.q, rate, cutoff), low_pass(one.tau, rate, cutoff)
            dq = differentiate(q, rate) if "dq" in missing else low_pass(one.dq, rate, cutoff)
            ddq = differentiate(low_pass(dq, rate, cutoff), rate) if "ddq" in missing else one.ddq
        except ValueError:  # a fragment too short to filter says nothing about acceleration
            dropped += len(one)
            continue
        smooth = Samples(given.joint_names, one.t, one.episode, q, dq, ddq, tau)
        kept = smooth.rows(slice(edge, max(edge, len(one) - edge)))
        if len(kept):
            parts.append(kept)
        dropped += len(one) - len(kept)
    steps.append(f"q, tau{'' if 'dq' in missing else ', dq'} low-passed at {cutoff:g} Hz without delay")
    steps.append(f"{' and '.join(missing)} derived by central differences")
    steps.append(f"{dropped} samples cut off at the filter's edges")
    if not parts:
        raise invalid_data("rows", len(given), f"a contiguous part long enough to filter at {cutoff:g} Hz")
    return Samples.concatenate(parts)


def _rate(t: Array, episode: Array | np.ndarray[Any, np.dtype[np.int64]]) -> float:
    step = np.diff(t)[np.diff(episode) == 0]
    if len(step) == 0:
        raise invalid_data("episode", "one sample each", "episodes of several samples")
    usual = float(np.median(step))
    if usual < 1 / MAX_RATE:
        raise invalid_data("t", f"in steps of {usual:g}", f"seconds, in steps of at least {1 / MAX_RATE:g}")
    return 1 / usual


def _split_at_gaps(
    t: Array, episode: np.ndarray[Any, np.dtype[np.int64]], rate: float
) -> tuple[np.ndarray[Any, np.dtype[np.int64]], int]:
    changes = np.diff(episode) != 0
    gap = ~changes & (np.diff(t) * rate > GAP)
    numbered = np.concatenate([[0], np.cumsum(changes | gap)]).astype(np.int64)
    return numbered, int(gap.sum())


def _check_even(t: Array, rate: float, first: int) -> None:
    if len(t) < 2:
        return
    deviation = np.abs(np.diff(t) * rate - 1)
    worst = int(deviation.argmax())
    if deviation[worst] > JITTER:
        raise invalid_data(
            f"t, row {first + worst + 2}",
            f"{np.diff(t)[worst]:g} s after the row before",
            f"steps of {1 / rate:g} s within {JITTER:.0%}, since accelerations must be derived",
        )


def _report(
    samples: Samples, rows: int, rate: float | None, gaps: int, missing: list[str], steps: list[str]
) -> dict[str, Any]:
    parts = samples.episodes()
    warnings = [
        f"tau{joint + 1} is constant: nothing can be learnt about this joint's torque"
        for joint, span in enumerate(np.ptp(samples.tau, axis=0))
        if span == 0
    ]
    return {
        "rows_uploaded": rows,
        "rows": len(samples),
        "episodes": len(parts),
        "rate_hz": rate,
        "gaps": gaps,
        "derived": missing,
        "preparation": steps,
        "ranges": {
            name: {
                "min": getattr(samples, name).min(axis=0).tolist(),
                "max": getattr(samples, name).max(axis=0).tolist(),
            }
            for name in ("q", "dq", "ddq", "tau")
        },
        "torque_noise_estimate": noise_level([samples.tau[part] for part in parts]).tolist(),
        "warnings": warnings,
    }

"""How many independent samples and motions there are: rows of a fast stream tell nearly the same."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array

INDEPENDENT_HZ = 10.0
"""Rows a second that count as independent.

Measured (`independent_rows.py 2 5` of benchmarks/studies) on a simulated Panda with friction that no estimator
expresses exactly, after 30 s at 1 kHz: where every row counted in full, 95 % intervals on an unseen trajectory covered
53 % (slow motion) and 82 % (faster), with nMSE 1.4e-1 and 1.5e-2; at ten rows a second 92 % and 95 %, with 2.7e-2 and
1.1e-2; at five no more. The best nMSE of the faster motion was 9.3e-3, at fifty.
"""


def even_weights(time: Array) -> Array:
    """Weights of rows that a clock has spaced evenly, whatever a few of their times say: the same for all, (N,).

    time: (N,) s; not finite where not known. Rows without a spacing count in full.
    """
    steps = np.diff(time[np.isfinite(time)])
    rising = steps[steps > 0]
    return np.full(len(time), min(1.0, INDEPENDENT_HZ * float(np.median(rising))) if len(rising) else 1.0)


def recording_weights(time: Array, episode: NDArray[np.int64], rate: float = INDEPENDENT_HZ) -> Array:
    """Weight of each row of a recording, (N,), from 0 to 1: `rate` times the seconds since the row before in its
    episode, 1 at most; the first of an episode counts as the second does, and a row without a neighbour in full.

    time, episode: (N,). A row's weight depends on its neighbours alone: those of a piece are those of the whole, where
    the piece has one more row at both ends.
    """
    if not len(time):
        return np.empty(0)
    joined = np.diff(episode) == 0
    steps = np.where(joined, np.diff(time), np.nan)
    since = np.concatenate([[np.nan], steps])
    until = np.concatenate([steps, [np.nan]])
    seconds = np.where(np.isfinite(since), since, until)
    return np.clip(rate * np.where(np.isfinite(seconds), seconds, np.inf), 0.0, 1.0)


def stream_weights(time: Array, before: float | None = None, rate: float = INDEPENDENT_HZ) -> Array:
    """Weight of each row, (N,), from 0 to 1: `rate` times the seconds since the row before, 1 at most.

    The noise of a sensor may be new every millisecond, but what a model cannot express, such as friction that is not as
    it should be, is the same for as long as the motion is: a thousand rows of one second are not a thousand witnesses.
    Counted as such they make a model certain of its own misfit. The sum over a stream is `rate` times its duration,
    whatever its own rate and however its rows were bunched on their way.

    time: (N,) event time, s, in the order of the stream; before: that of the row before the first, where known. Rows of
    one time, as of a batch without times of its own, share the time since then evenly.
    """
    if not len(time):
        return np.empty(0)
    order = np.argsort(time, kind="stable")
    steps = np.diff(time[order])
    if not (steps > 0).any():
        steps = np.full(len(time), np.inf if before is None else max(time[0] - before, 0.0) / len(time))
    else:
        first = np.median(steps[steps > 0]) if before is None else max(time[order[0]] - before, 0.0)
        steps = np.concatenate([[first], steps])
    out = np.empty(len(time))
    out[order] = np.minimum(rate * steps, 1.0)
    return out


def motion_dimensions(dq: Array) -> float:
    """How many joints' worth of independent motion velocities (N, n) hold: 1 where all move together, n where each
    moves by itself.

    The participation ratio (Σ λ)² / Σ λ² of their correlation matrix's eigenvalues.
    """
    spread = dq.std(axis=0)
    moving = spread > 1e-9
    if not moving.any():
        return 0.0
    values = np.linalg.eigvalsh(np.atleast_2d(np.corrcoef(dq[:, moving].T)))
    return float(values.sum() ** 2 / np.square(values).sum())

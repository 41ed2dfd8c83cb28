"""Effective samples and independent motions: neighbouring rows of a fast stream are nearly equal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array

INDEPENDENT_HZ = 10.0
"""Effective samples per second.

Measured with `independent_rows.py 2 5` of benchmarks/studies on a simulated Panda with friction that no estimator
expresses exactly, after 30 s at 1 kHz. With full weight for every row, 95 % intervals on an unseen trajectory covered
53 % (slow motion) and 82 % (faster), with nMSE 1.4e-1 and 1.5e-2. At ten rows a second they covered 92 % and 95 %, with
2.7e-2 and 1.1e-2. Five rows a second covered no more. The best nMSE of the faster motion was 9.3e-3, at fifty.
"""


def even_weights(time: Array) -> Array:
    """Return the weights of rows that a clock has spaced evenly: the same for all, (N,), whatever single times are.

    time: (N,) s, not finite if unknown. Rows without a spacing have weight 1.
    """
    steps = np.diff(time[np.isfinite(time)])
    rising = steps[steps > 0]
    return np.full(len(time), min(1.0, INDEPENDENT_HZ * float(np.median(rising))) if len(rising) else 1.0)


def recording_weights(time: Array, episode: NDArray[np.int64], rate: float = INDEPENDENT_HZ) -> Array:
    """Return the weight of each row of a recording, (N,), from 0 to 1.

    The weight is `rate` times the seconds since the previous row of its episode, at most 1. The first row of an episode
    has the weight of the second, and a row without a neighbour has weight 1.

    time, episode: (N,). A weight depends on neighbouring rows only: a piece of a recording has the weights of the whole
    if the piece has one more row at both ends.
    """
    if not len(time):
        return np.empty(0)
    joined = np.diff(episode) == 0
    steps = np.where(joined, np.diff(time), np.nan)
    since = np.concatenate([[np.nan], steps])
    until = np.concatenate([steps, [np.nan]])
    seconds = np.where(np.isfinite(since), since, until)
    return np.clip(rate * np.where(np.isfinite(seconds), seconds, np.inf), 0.0, 1.0)


def thinned_weights(time: Array) -> Array:
    """Return the weights of the rows of a thinned table, (N,): each is an episode, so only times count.

    time: (N,) s, in the order of episodes. A time that does not rise starts a new recording.
    """
    return recording_weights(time, np.cumsum(np.diff(time, prepend=-np.inf) <= 0, dtype=np.int64))


def stream_weights(time: Array, before: float | None = None, rate: float = INDEPENDENT_HZ) -> Array:
    """Return the weight of each row of a stream, (N,), from 0 to 1.

    The weight is `rate` times the seconds since the previous row, at most 1. A sensor's noise may be new every
    millisecond, but a model's misfit, such as other friction, lasts as long as the motion. With full weight, a thousand
    rows of one second would make a model certain of its own misfit. The weights of a stream sum to `rate` times its
    duration, for any sampling rate and any bunching of its rows.

    time: (N,) event time, s, in the order of the stream; before: time of the row before the first, if known. Rows of
    equal time, as of a batch without times, share the time since then evenly.
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
    """Return the number of independent motions in velocities (N, n).

    It is 1 if all joints move together, n if each moves independently, and 0 if no joint moves. This is the
    participation ratio (Σ λ)² / Σ λ² of the eigenvalues of the correlation matrix of the velocities.
    """
    spread = dq.std(axis=0)
    moving = spread > 1e-9
    if not moving.any():
        return 0.0
    values = np.linalg.eigvalsh(np.atleast_2d(np.corrcoef(dq[:, moving].T)))
    return float(values.sum() ** 2 / np.square(values).sum())

"""Selection of few samples, or few torques, that represent all: farthest points, and pivoted Cholesky."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lipcore.data.motion import Array, Indices, Motion
from lipcore.kernels.drive.terms import drive_features

PREFERENCE = 10.0
"""Preference for outputs of samples that are already chosen: one is chosen if its residual is at least a tenth of the
max.

All outputs of a sample cost a query little more than one. On a 500-sample simulated Panda, 350 outputs then belong to
51 samples instead of 240, with no larger deviation from the exact posterior.
"""


def spread_out(motion: Motion, count: int) -> Indices:
    """Return the indices of `count` samples that are far from each other, sorted; all indices if there are no more.

    Farthest-point selection on (cos q, sin q, q − mean, dq, sign dq, ddq), each scaled to the motion's spread. Every
    region of positions and every range of speeds is represented.
    """
    size = len(motion)
    if size <= count:
        return np.arange(size)
    spread = [each.std(0, ddof=1) for each in (motion.q, motion.dq, motion.ddq)]
    angle = (motion.q - motion.q.mean(0)) / spread[0].clip(1.0)
    features = np.concatenate(
        [
            np.cos(motion.q),
            np.sin(motion.q),
            angle,
            motion.dq / spread[1].clip(1e-6),
            0.5 * drive_features(motion.dq)[1],
            motion.ddq / spread[2].clip(1e-6),
        ],
        axis=1,
    )
    features -= features.mean(0)
    squares = np.einsum("kd,kd->k", features, features)
    chosen, distance = [int(squares.argmax())], np.full(size, np.inf)
    while len(chosen) < count:
        last = chosen[-1]
        distance = np.minimum(distance, squares + squares[last] - 2 * (features @ features[last]))
        distance[chosen] = -1.0  # a chosen sample must not be chosen again; another sample that equals it may be
        chosen.append(int(distance.argmax()))
    return np.array(sorted(chosen))


@dataclass(frozen=True)
class Pivots:
    """Outputs in the order of choice, (m,), with their columns of L, (M, m), for all M outputs.

    residual: (m,), max variance that the outputs chosen before each step do not explain.
    """

    outputs: Indices
    lower: Array
    residual: Array

    def __len__(self) -> int:
        return len(self.outputs)


@dataclass(frozen=True)
class TargetFunction:
    """A function that a Gaussian process interpolates from the chosen outputs."""

    values: Array
    """(M,)."""
    count: int
    """Number of outputs that are each the one at which interpolation from those before has the largest error."""
    weights: Array
    """Factors on the residual variances that choose the other outputs, (M,)."""


def pivots(gram: Array, per_sample: int, most: int, residual: float, function: TargetFunction | None = None) -> Pivots:
    """Return at most `most` outputs, chosen until no residual variance exceeds `residual`.

    gram: (M, M), outputs sample by sample, `per_sample` each. It is read column by column and not modified; function:
    the outputs interpolate it; if it is None, each output has the largest residual variance.
    """
    size = len(gram)
    lower = np.zeros((min(most, size), size))  # L transposed, so that its columns are contiguous
    left = gram.diagonal().copy()
    stop = max(residual, 1e-13 * float(left.max()))  # below this, variances are rounding errors
    handicap = np.full((size,), 1 / PREFERENCE)
    function = function or TargetFunction(np.zeros(size), 0, np.ones(size))
    error = function.values
    chosen: list[int] = []
    residuals: list[float] = []
    while len(chosen) < len(lower) and float(left.max()) > stop:
        step = len(chosen)
        gain = np.abs(error) * (left > stop) if step < function.count else left * function.weights
        pivot = int(((gain if gain.any() else left) * handicap).argmax())
        row = (gram[pivot] - lower[:step, pivot] @ lower[:step]) / np.sqrt(left[pivot])
        error = error - error[pivot] / row[pivot] * row
        lower[step] = row
        residuals.append(float(left.max()))
        chosen.append(pivot)
        left = (left - np.square(row)).clip(0.0)
        left[pivot] = 0.0
        sample = pivot // per_sample
        handicap[sample * per_sample : (sample + 1) * per_sample] = 1.0
    return Pivots(np.array(chosen, np.int64), lower[: len(chosen)].T, np.array(residuals))

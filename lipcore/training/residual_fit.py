"""Fit of one joint's residual: its centres, their weights from all samples, and the errors on held-out blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import Indices
from lipcore.data.samples import Array
from lipcore.data.splits import SplitRows
from lipcore.kernels.residual import JointResidual
from lipcore.posterior.linalg import (
    Factor,
    add_diagonal,
    add_square_of_rows,
    cholesky,
    mirror,
    solve_lower,
    solve_lower_right,
    whiten_rows,
)
from lipcore.posterior.selection import pivots
from lipcore.training.lengthscales import Shape

Blocks = Sequence[tuple[slice, SplitRows]]
"""Contiguous blocks of N samples, which they cover, each with the rows to train on and to test."""
CHUNK = 2048
"""Samples of one matrix product."""


@dataclass(frozen=True)
class ResidualOptions:
    """Numbers of centres, and the gain that a correction needs."""

    min_gain: float = 0.2
    """Min gain of a corrected joint, as a share of its squared error."""
    min_gain_errors: float = 2.82
    """The same in standard errors: the 99 % point of t for ten blocks."""
    sizes: tuple[int, ...] = (25, 50, 100, 200, 400, 800, 1500)
    """Numbers of centres that are tried, the fewest first."""
    min_progress: float = 0.02
    """Min gain of the squared error from more centres than `fast`."""
    features: int = 100
    """Max number of centres that standard deviations and streams use, because their cost grows with its square."""
    fast: int = 200
    """Max number of centres of fast answers, because the cost of a mean grows with it."""
    open_share: float = 1e-4
    """Max share of the correction's variance that the centres do not explain at the samples."""


OPTIONS = ResidualOptions()


@dataclass(frozen=True)
class Centres:
    """Centres of one joint's residual, chosen among N samples."""

    scaled: Array
    """Inputs of the samples in lengthscales, (N, 4 n), of float32 numbers."""
    rows: Indices
    """Rows of the centres, (m,), in the order of choice."""
    root: Array
    """Cholesky factor of their correlations, (m, m)."""

    @classmethod
    def choose(cls, inputs: Array, lengthscales: Array, candidates: Indices) -> Centres:
        """Return centres. inputs: (N, 4 n); lengthscales: (4 n,); candidates: rows to choose from."""
        scaled = (inputs / lengthscales).astype(np.float32).astype(np.float64)
        some = scaled[candidates]
        order = pivots(_correlations(some, some), 1, OPTIONS.sizes[-1], OPTIONS.open_share)
        return cls(scaled, candidates[order.outputs], np.ascontiguousarray(order.lower[order.outputs]))

    def sizes(self) -> list[int]:
        """Return the numbers of centres to try."""
        count = len(self.rows)
        return [*(size for size in OPTIONS.sizes if size < count), count]

    def features(self, blocks: Blocks) -> tuple[NDArray[np.float32], Array]:
        """Return the whitened correlations φ of the N samples with the centres, (N, m), and their nearness, (N, sizes).

        The nearness is the largest squared correlation with one of the first centres that is not held out with the
        sample, for each number of `sizes`.
        """
        sizes = self.sizes()
        features = np.empty((len(self.scaled), len(self.rows)), np.float32)
        nearness = np.empty((len(self.scaled), len(sizes)))
        for block, parts in blocks:
            others = parts.train[self.rows]
            for first in range(block.start, block.stop, CHUNK):
                rows = slice(first, min(first + CHUNK, block.stop))
                near = _correlations(self.scaled[rows], self.scaled[self.rows])
                most = [(near * others)[:, a:b].max(axis=1) for a, b in pairwise([0, *sizes])]
                nearness[rows] = np.maximum.accumulate(np.square(most), axis=0).T
                whiten_rows(self.root, near)
                features[rows] = near
        return features, nearness


@dataclass(frozen=True)
class BlockSums:
    """Sums over N samples y = s φᵀu + e of a joint's residual, with whitened variables u, in all and by block.

    They are `posterior.statistics` for one torque: R is the noise plus the variance s² (1 − |φ|²) outside the features.
    """

    features: NDArray[np.float32]
    """φ, (N, m)."""
    std: float
    """s, N·m."""
    beyond: Array
    """s² (1 − |φ|²), (N,)."""
    a: Array
    """s² Σ φ R⁻¹ φᵀ, (m, m)."""
    b: Array
    """s Σ φ R⁻¹ y, (m,)."""
    left: tuple[tuple[Array, Array], ...]
    """Both sums of the samples that each block's training does not use."""

    @classmethod
    def of(
        cls, features: NDArray[np.float32], variance: float, noise: Array, values: Array, blocks: Blocks
    ) -> BlockSums:
        """Return the sums of N samples. features: φ, (N, m); variance: s²; noise: (N,); values: y, (N,)."""
        size, std = features.shape[1], float(np.sqrt(variance))
        beyond = variance * np.maximum(1 - np.einsum("km,km->k", features, features, dtype=np.float64), 0.0)
        root = 1 / np.sqrt(noise + beyond)

        def sums(rows: Indices) -> tuple[Array, Array]:
            a, b = np.zeros((size, size)), np.zeros(size)
            for first in range(0, len(rows), CHUNK):
                part = rows[first : first + CHUNK]
                weighed = features[part] * (std * root[part, None])
                add_square_of_rows(a, weighed)
                b += (root[part] * values[part]) @ weighed
            return a.T, b  # the lower triangle is read

        a, b, left = np.zeros((size, size)), np.zeros(size), []
        for block, parts in blocks:
            guard = ~parts.train
            guard[block] = False
            own, around = sums(np.arange(block.start, block.stop)), sums(np.flatnonzero(guard))
            a, b = a + own[0], b + own[1]
            left.append((own[0] + around[0], own[1] + around[1]))
        return cls(features, std, beyond, a, b, tuple(left))

    def predict_mean(self, blocks: Blocks) -> Array:
        """Return the mean of the residual at all samples, (N,), each block from the samples of the others."""
        mean = np.empty(len(self.beyond))
        for (block, _), (a, b) in zip(blocks, self.left, strict=True):
            mean[block] = self.std * (self.features[block] @ _factor(self.a - a).solve(self.b - b))
        return mean

    def predict_variance(self, blocks: Blocks) -> Array:
        """Return the variance of the residual at all samples, (N,), each block from the samples of the others."""
        variance = self.beyond.copy()
        for (block, _), (a, _) in zip(blocks, self.left, strict=True):
            features = self.std * self.features[block].T.astype(np.float64)
            variance[block] += np.square(_factor(self.a - a).whiten(features)).sum(axis=0)
        return variance

    def variables(self) -> Array:
        """Return the mean of u from all samples, (m,)."""
        return _factor(self.a).solve(self.b)


def _factor(a: Array) -> Factor:
    """Return the Cholesky factor of I + A, read from its lower triangle."""
    a = a.copy()
    add_diagonal(a, 1.0)
    return cholesky(a)


@dataclass(frozen=True)
class MeanFit:
    """The mean of a joint's residual from some number of centres."""

    variables: Array
    """Mean of their whitened variables, (size,)."""
    error: float
    """Squared error with it, divided by that without."""
    taken: float
    """Share of what `few` features leave that the centres explain, see `JointResidual`."""


@dataclass(frozen=True)
class JointFit:
    """A joint's residual from N samples, and the errors of their blocks."""

    centres: Centres
    shape: Shape
    rich: MeanFit
    """From the chosen number of centres."""
    fast: MeanFit
    """From at most `fast` of them."""
    a: Array
    """A of the features, at most `features` of them, with `variance` and `noise`, (k, k)."""
    held_out: Array
    """Mean and variance at all samples, each block from the others, (2, N)."""
    gains: bool
    """Whether `rich` reduces the error beyond chance."""
    variance: float
    """Variance without data, (N·m)²."""
    noise: float
    """Variance of the noise, (N·m)²."""

    @classmethod
    def of(
        cls,
        inputs: Array,
        values: Array,
        weights: Array,
        blocks: Blocks,
        shape: Shape,
        noise: float,
        candidates: Indices,
    ) -> JointFit:
        """Return the fit of N samples.

        inputs: (N, 4 n); values: residuals, (N,) N·m; weights: of the samples, (N,); noise: of the arm alone, (N·m)²;
        candidates: rows to choose centres from. Both variances are scaled to the errors; far from the samples, the
        torque is as uncertain as the arm's.
        """
        centres = Centres.choose(inputs, shape.lengthscales, candidates)
        features, nearness = centres.features(blocks)
        white, sizes = shape.noise / weights, centres.sizes()

        def errors(predicted: Array | float) -> Array:
            return np.array([np.mean(np.square(values - predicted)[parts.held_out]) for _, parts in blocks])

        def sums_of(place: int) -> BlockSums:
            return BlockSums.of(features[:, : sizes[place]], shape.variance, white, values, blocks)

        rich = fast = few = 0
        sums = fast_sums = sums_of(0)
        predicted = quickly = sums.predict_mean(blocks)
        for place in range(1, len(sizes)):
            larger = sums_of(place)
            mean = larger.predict_mean(blocks)
            slow = sizes[place] > OPTIONS.fast
            if slow and errors(mean).mean() > (1 - OPTIONS.min_progress) * errors(predicted).mean():
                break
            rich, sums, predicted = place, larger, mean
            if not slow:
                fast, fast_sums, quickly = place, larger, mean
            if sizes[place] <= OPTIONS.features:
                few = place
        without = errors(0.0)
        gain = without - errors(predicted)
        chance = OPTIONS.min_gain_errors * gain.std(ddof=1) / np.sqrt(len(gain))
        tested, squares = np.any([parts.held_out for _, parts in blocks], axis=0), np.square(values - predicted)
        first = sums_of(few)
        variances, open_ = first.predict_variance(blocks), first.beyond * nearness[:, rich]
        variances -= _taken(variances + shape.noise - squares, open_, tested) * open_
        stretch = max(0.01, float(np.mean((squares / (variances + shape.noise))[tested])))
        own = stretch * shape.noise
        variance = max(stretch * shape.variance, noise - own)
        scaled = BlockSums.of(first.features, variance, own / weights, values, blocks)
        variances = scaled.predict_variance(blocks)

        def fitted(place: int, sums: BlockSums, mean: Array) -> MeanFit:
            error = float(errors(mean).mean() / without.mean()) if without.any() else 1.0
            taken = _taken(variances + own - np.square(values - mean), scaled.beyond * nearness[:, place], tested)
            return MeanFit(sums.variables(), error, taken)

        best, quick = fitted(rich, sums, predicted), fitted(fast, fast_sums, quickly)
        gains = bool(gain.mean() > max(OPTIONS.min_gain * without.mean(), chance))
        held_out = np.stack([predicted, variances - best.taken * scaled.beyond * nearness[:, rich]])
        a = scaled.a
        mirror(a)
        return cls(centres, shape, best, quick, a, held_out, gains, variance, own)

    def residual(self) -> JointResidual:
        """Return the residual."""
        count, few = len(self.rich.variables), len(self.a)
        root = self.centres.root
        weights, fast_weights = (
            np.sqrt(self.shape.variance)
            * solve_lower(_first(root, len(each.variables)), each.variables, transposed=True)
            for each in (self.rich, self.fast)
        )
        return JointResidual(
            self.shape.lengthscales,
            self.centres.scaled[self.centres.rows[:count]],
            weights,
            np.sqrt(self.variance) * solve_lower_right(np.eye(few), _first(root, few)),
            self.variance,
            self.rich.taken,
            fast_weights,
            self.fast.taken,
        )


def _first(root: Array, size: int) -> Array:
    return np.ascontiguousarray(root[:size, :size])


def _correlations(a: Array, b: Array) -> Array:
    """Return exp(−½ |a − b|²), (K, m). a: (K, D); b: (m, D)."""
    squares = np.einsum("kd,kd->k", a, a)[:, None] - 2 * (a @ b.T) + np.einsum("md,md->m", b, b)
    return np.asarray(np.exp(-0.5 * np.maximum(squares, 0.0)))


def _taken(excess: Array, open_: Array, tested: NDArray[np.bool_]) -> float:
    """Return the share of `open_` by which variances exceed squared errors, 0 to 1, over the tested of N samples.

    excess: variances minus squared errors, (N,); open_: what features leave, times nearness, (N,).
    """
    most = float(open_[tested].mean())
    return min(max(float(excess[tested].mean()) / most, 0.0), 1.0) if most > 0 else 0.0

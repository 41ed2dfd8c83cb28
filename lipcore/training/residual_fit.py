"""Fit of one joint's residual: its centres, their weights from all samples, and the errors on held-out blocks."""

from __future__ import annotations

from dataclasses import dataclass, replace

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
)
from lipcore.training.centres import CHUNK, Blocks, Centres, blocks_of
from lipcore.training.lengthscales import Shape


@dataclass(frozen=True)
class ResidualOptions:
    """Gains that a correction and more centres need."""

    min_gain: float = 0.2
    """Min gain of a corrected joint, as a share of its squared error."""
    min_gain_errors: float = 2.82
    """The same in standard errors: the 99 % point of t for ten blocks."""
    max_progress: float = 0.02
    """Max gain of the squared error from more centres than the chosen number."""


OPTIONS = ResidualOptions()


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

    def symmetric(self) -> Array:
        """Return A with both triangles."""
        a = self.a.copy()
        mirror(a)
        return a

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
    """The mean of a joint's residual from the first of its centres."""

    variables: Array
    """Mean of their whitened variables, (size,)."""
    held_out: Array
    """Mean at all samples, each block from the others, (N,) N·m."""
    errors: Array
    """Squared error of each held-out block, (B,) (N·m)²."""

    @classmethod
    def of(cls, sums: BlockSums, values: Array, blocks: Blocks) -> MeanFit:
        """Return the mean from the sums of N samples. values: (N,) N·m."""
        mean = sums.predict_mean(blocks)
        return cls(sums.variables(), mean, block_errors(values - mean, blocks))


def block_errors(residual: Array, blocks: Blocks) -> Array:
    """Return the mean square of a residual over each held-out block, (B,). residual: (N,)."""
    return np.array([np.mean(np.square(residual)[parts.held_out]) for _, parts in blocks])


@dataclass(frozen=True)
class JointFit:
    """A joint's residual from N samples, and the errors of their blocks."""

    centres: Centres
    rich: MeanFit
    """From the chosen number of centres."""
    fast: MeanFit
    """From at most `fast` of them."""
    a: Array
    """A of the features, at most `features` of them, with `variance` and `noise`, (k, k)."""
    held_out: Array
    """Mean and variance at all samples, each block from the others, (2, N)."""
    without: Array
    """Squared error of each held-out block without the residual, (B,) (N·m)²."""
    mean_variance: float
    """Variance without data of the means' fit, (N·m)²."""
    variance: float
    """Variance without data, (N·m)²."""
    noise: float
    """Variance of the noise, (N·m)²."""
    taken: float
    """Share of what the features leave that all centres of `rich` explain, see `JointResidual`."""
    fast_taken: float
    """The same of `fast`."""

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
        white, some = shape.noise / weights, candidates
        centres, chosen = Centres.choose(
            inputs[some], shape.lengthscales, values[some], white[some] / shape.variance, blocks_of(some, blocks)
        )
        (features, nearness), sizes = centres.features(inputs, some[chosen], blocks), centres.sizes()

        def sums_of(place: int) -> BlockSums:
            return BlockSums.of(features[:, : sizes[place]], shape.variance, white, values, blocks)

        fast = min(1, len(sizes) - 1)
        means = [MeanFit.of(sums_of(place), values, blocks) for place in range(fast, len(sizes))]
        errors = [float(each.errors.mean()) for each in means]
        enough = next(k for k, error in enumerate(errors) if (1 - OPTIONS.max_progress) * error <= min(errors))
        rich, best, quick = fast + enough, means[enough], means[0]
        tested = np.any([parts.held_out for _, parts in blocks], axis=0)

        def taken(variances: Array, beyond: Array, mean: MeanFit, place: int) -> float:
            return _taken(variances - np.square(values - mean.held_out), beyond * nearness[:, place], tested)

        first = sums_of(0)
        variances = first.predict_variance(blocks)
        variances -= taken(variances + shape.noise, first.beyond, best, rich) * first.beyond * nearness[:, rich]
        expected = variances + shape.noise
        stretch = max(0.01, float(np.mean((np.square(values - best.held_out) / expected)[tested])))
        own = stretch * shape.noise
        variance = max(stretch * shape.variance, noise - own)
        scaled = BlockSums.of(first.features, variance, own / weights, values, blocks)
        variances = scaled.predict_variance(blocks)
        shares = [taken(variances + own, scaled.beyond, *each) for each in ((best, rich), (quick, fast))]
        return cls(
            centres,
            best,
            quick,
            scaled.symmetric(),
            np.stack([best.held_out, variances - shares[0] * scaled.beyond * nearness[:, rich]]),
            block_errors(values, blocks),
            shape.variance,
            variance,
            own,
            *shares,
        )

    @property
    def gains(self) -> bool:
        """Whether `rich` reduces the error beyond chance."""
        gain = self.without - self.rich.errors
        chance = OPTIONS.min_gain_errors * gain.std(ddof=1) / np.sqrt(len(gain))
        return bool(gain.mean() > max(OPTIONS.min_gain * self.without.mean(), chance))

    def share(self, mean: MeanFit) -> float:
        """Return the squared error with a mean, divided by that without."""
        return float(mean.errors.mean() / self.without.mean()) if self.without.any() else 1.0

    def residual(self) -> JointResidual:
        """Return the residual."""
        few = len(self.a)
        weights, fast_weights = (
            _weights(self.centres.root, self.mean_variance, each.variables) for each in (self.rich, self.fast)
        )
        return JointResidual(
            self.centres.lengthscales,
            self.centres.places[: len(weights)],
            weights,
            np.sqrt(self.variance) * solve_lower_right(np.eye(few), _first(self.centres.root, few)),
            self.variance,
            self.taken,
            fast_weights,
            self.fast_taken,
        )


def learn_weights(
    joint: JointResidual, inputs: Array, values: Array, weights: Array, noise: float
) -> tuple[JointResidual, Array]:
    """Return a residual with weights learnt from other samples, and A of its features, (k, k).

    Centres and variances stay. Arguments: see `JointFit.of`; noise: beside the residual, (N·m)².
    """
    centres, every = Centres.of(joint), slice(0, len(inputs))
    features = np.concatenate([centres.whiten(near) for _, near in centres.near(inputs, every)])
    blocks = [(every, SplitRows(np.ones(len(inputs), bool), np.zeros(len(inputs), bool)))]
    few, fast, rich = (
        BlockSums.of(features[:, :size], joint.variance, noise / weights, values, blocks)
        for size in (len(joint.root), len(joint.fast_weights), len(joint.weights))
    )
    found, fast_found = (_weights(centres.root, joint.variance, each.variables()) for each in (rich, fast))
    return replace(joint, weights=found, fast_weights=fast_found), few.symmetric()


def _weights(root: Array, variance: float, variables: Array) -> Array:
    """Return the weights of correlations, (m,) N·m. variables: mean of the whitened variables, (m,)."""
    return float(np.sqrt(variance)) * solve_lower(_first(root, len(variables)), variables, transposed=True)


def _first(root: Array, size: int) -> Array:
    return np.ascontiguousarray(root[:size, :size])


def _taken(excess: Array, open_: Array, tested: NDArray[np.bool_]) -> float:
    """Return the share of `open_` by which variances exceed squared errors, 0 to 1, over the tested of N samples.

    excess: variances minus squared errors, (N,); open_: what features leave, times nearness, (N,).
    """
    most = float(open_[tested].mean())
    return min(max(float(excess[tested].mean()) / most, 0.0), 1.0) if most > 0 else 0.0

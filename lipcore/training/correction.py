"""A local correction of an arm: the arm's residual, if another part of the recording predicts it.

The residual of an arm lasts: it is the same near a sample, whether or not the arm returns there. So blocks of the
recording are held out in turn, with the instants next to them, and predicted from the others. A joint is corrected if
this reduces its error beyond chance. The arm does not change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from lipcore.data import metrics
from lipcore.data.independence import recording_weights
from lipcore.data.metrics import LEVEL, quantile
from lipcore.data.motion import Indices
from lipcore.data.samples import Array, Samples
from lipcore.data.splits import GUARD_S, SplitRows, apply_guard
from lipcore.kernels.residual import JointResidual, ResidualKernel, residual_inputs
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.conformal import Conformal, conformal_of
from lipcore.posterior.linalg import add_diagonal, block_diagonal, cholesky, solve_lower, solve_lower_right
from lipcore.posterior.selection import Pivots, pivots
from lipcore.training import lengthscales
from lipcore.training.lengthscales import Shape, fit_shapes


@dataclass(frozen=True)
class CorrectionOptions:
    """Evaluation of a correction, and its size."""

    max_rows: int = 3000
    """Max rows that are used."""
    rows_each: float = 2.0
    """Max rows for each effective sample (`data.independence`)."""
    blocks: int = 10
    """Blocks that are held out in turn."""
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


OPTIONS = CorrectionOptions()
REPORT_PREFIX = "local_"
"""Prefix of entries of a fit's report, one for each corrected joint: the remaining share of its squared error."""


@dataclass(frozen=True)
class Correction:
    """A correction and its gain."""

    residual: ResidualKernel
    noise: Array
    """Variance of the noise beside it, (n,) (N·m)²."""
    a: Array
    """A of the samples (see `posterior.statistics`) for its weights, (p, p)."""
    errors: Array
    """Squared error of held-out blocks with the correction, divided by that without, (n,); 1 for joints without
    correction."""
    fast_errors: Array
    """The same with fast answers."""
    conformal: Conformal | None
    """Factors on the intervals of corrected joints, from held-out blocks; None if there are none."""

    def report(self) -> dict[str, float]:
        """Return the errors of corrected joints, for the manifest."""
        return {
            f"{prefix}{j + 1}": round(float(errors[j]), 3)
            for prefix, errors in ((REPORT_PREFIX, self.errors), (f"fast_{REPORT_PREFIX}", self.fast_errors))
            for j in np.flatnonzero(self.errors < 1).tolist()
        }


def corrected_joints(report: Mapping[str, object]) -> list[int]:
    """Return the corrected joints of a fit's report, from 0."""
    return [int(key.removeprefix(REPORT_PREFIX)) - 1 for key in report if key.startswith(REPORT_PREFIX)]


def correct(arm: CompactPosterior, samples: Samples, joints: Sequence[int] = ()) -> Correction:
    """Return a correction of an arm's residuals of N samples.

    joints: to correct in any case, as an earlier fit did. If the recording is too short for held-out blocks, no joint
    is corrected.
    """
    ordered = samples.rows(np.lexsort((samples.t, samples.episode)))
    count = min(OPTIONS.max_rows, OPTIONS.rows_each * float(_weights(ordered).sum()))
    evenly = np.linspace(0, len(samples) - 1, max(2, round(count))).round().astype(np.int64)
    used, n = ordered.rows(np.unique(evenly)), samples.n_joints
    noise, score = arm.noise_variance.copy(), np.zeros(used.tau.shape)
    errors, fast_errors = np.ones((2, n))
    found, blocks, conformal = [JointResidual.none(n)] * n, held_out_blocks(used), None
    sums = [np.zeros((0, 0))] * n
    if blocks:
        motion, weights = used.motion(), _weights(used)
        inputs, known = residual_inputs(motion), arm.predict(motion)
        left = used.tau - known.mean
        block = np.repeat(np.arange(len(blocks)), [rows.stop - rows.start for rows, _ in blocks])
        for j, shape in enumerate(fit_shapes(inputs, left, weights, block)):
            if shape.gain < lengthscales.OPTIONS.min_gain_nats and j not in joints:
                continue
            fit = JointFit.of(inputs, left[:, j], weights, blocks, shape, float(noise[j]))
            if fit.gains or j in joints:
                found[j], noise[j] = fit.residual(), fit.noise
                errors[j], fast_errors[j], sums[j] = min(fit.rich.error, 1.0), fit.fast.error, fit.few.a
                mean, variance = fit.held_out
                variance = variance + noise[j] + known.covariance[:, j, j]
                half = quantile(LEVEL) * np.sqrt(variance)
                score[:, j] = np.abs(left[:, j] - mean) / half
        conformal = conformal_of(score, metrics.blocks(used))
    return Correction(ResidualKernel(found), noise, block_diagonal(sums), errors, fast_errors, conformal)


def _weights(samples: Samples) -> Array:
    """Return the weights of samples in order, (N,). Rows of a thinned table are single episodes, so only t counts."""
    course = np.cumsum(np.diff(samples.t, prepend=-np.inf) <= 0, dtype=np.int64)
    return recording_weights(samples.t, course)


def held_out_blocks(samples: Samples) -> list[tuple[slice, SplitRows]]:
    """Return blocks of samples in order, each with the rows to train on and to test; none if one is too short."""
    edges, out = np.linspace(0, len(samples), OPTIONS.blocks + 1).round().astype(np.int64), []
    for first, last in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        held = np.zeros(len(samples), dtype=bool)
        held[first:last] = True
        parts = apply_guard(samples.episode, samples.t, np.arange(len(samples)), held, GUARD_S)
        if not (parts.train.any() and parts.held_out.any()):
            return []
        out.append((slice(first, last), parts))
    return out


@dataclass(frozen=True)
class KnownSums:
    """Posterior of the m whitened variables of a Gaussian process g from N samples, y = g(x) + e.

    It is `posterior.statistics` for one torque: R is the noise plus the variance s² − |φ|² outside the features φ.
    """

    features: Array
    """φ, (N, m)."""
    beyond: Array
    """s² − |φ|², (N,)."""
    weighed: Array
    """R^-½ φ, (N, m)."""
    right: Array
    """R^-½ y, (N,)."""
    a: Array
    """Σ φ R⁻¹ φᵀ, (m, m)."""
    b: Array
    """Σ φ R⁻¹ y, (m,)."""

    @classmethod
    def of(cls, features: Array, variance: float, noise: Array, values: Array) -> KnownSums:
        """Return the sums of N samples. features: φ, (N, m); variance: s²; noise: (N,); values: y, (N,)."""
        beyond = np.maximum(variance - np.einsum("km,km->k", features, features), 0.0)
        root = np.sqrt(1 / (noise + beyond))
        weighed, right = features * root[:, None], values * root
        return cls(features, beyond, weighed, right, weighed.T @ weighed, weighed.T @ right)

    def predict(self, blocks: Sequence[tuple[slice, SplitRows]]) -> tuple[Array, Array]:
        """Return mean and variance of g at all samples, (N,) each, each block from the samples of the others."""
        mean, variance = np.empty((2, len(self.right)))
        for block, parts in blocks:
            left = self.weighed[~parts.train]
            a = self.a - left.T @ left
            add_diagonal(a, 1.0)
            factor, features = cholesky(a), self.features[block]
            mean[block] = features @ factor.solve(self.b - left.T @ self.right[~parts.train])
            variance[block] = self.beyond[block] + np.square(factor.whiten(features.T)).sum(axis=0)
        return mean, variance

    def mean(self) -> Array:
        """Return the mean of the variables from all samples, (m,)."""
        a = self.a.copy()
        add_diagonal(a, 1.0)
        return cholesky(a).solve(self.b)


@dataclass(frozen=True)
class MeanFit:
    """The mean of a joint's residual from some number of centres."""

    sums: KnownSums
    error: float
    """Squared error with it, divided by that without."""
    taken: float
    """Share of what `few` features leave that the centres explain, see `JointResidual`."""


@dataclass(frozen=True)
class JointFit:
    """Features of a joint's residual at N samples, and the errors of its blocks."""

    scaled: Array
    """Inputs in lengthscales, (N, 4 n), of float32 numbers."""
    order: Pivots
    """Centres among the samples, with their correlations' Cholesky factor."""
    shape: Shape
    rich: MeanFit
    """From the chosen number of centres."""
    fast: MeanFit
    """From at most `fast` of them."""
    few: KnownSums
    """Posterior from at most `features` of them, with `variance` and `noise`."""
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
        blocks: Sequence[tuple[slice, SplitRows]],
        shape: Shape,
        noise: float,
    ) -> JointFit:
        """Return the features of N samples, and the errors of their blocks.

        inputs: (N, 4 n); values: residuals, (N,) N·m; weights: of the samples, (N,); blocks: see `held_out_blocks`;
        noise: of the arm alone, (N·m)². Both variances are scaled to the errors; far from the samples, the torque is as
        uncertain as the arm's.
        """
        scaled = (inputs / shape.lengthscales).astype(np.float32).astype(np.float64)
        order = pivots(np.exp(-0.5 * cdist(scaled, scaled, "sqeuclidean")), 1, OPTIONS.sizes[-1], OPTIONS.open_share)
        features, white = order.lower * np.sqrt(shape.variance), shape.noise / weights

        def errors(predicted: Array | float) -> Array:
            return np.array([np.mean(np.square(values - predicted)[parts.held_out]) for _, parts in blocks])

        rich = few = fast = KnownSums.of(features[:, : OPTIONS.sizes[0]], shape.variance, white, values)
        predicted = quickly = rich.predict(blocks)[0]
        for size in OPTIONS.sizes[1:]:
            if len(rich.a) == len(order):
                break
            larger = KnownSums.of(features[:, :size], shape.variance, white, values)
            mean = larger.predict(blocks)[0]
            if size > OPTIONS.fast and errors(mean).mean() > (1 - OPTIONS.min_progress) * errors(predicted).mean():
                break
            rich, predicted = larger, mean
            if size <= OPTIONS.fast:
                fast, quickly = larger, mean
            if size <= OPTIONS.features:
                few = larger
        without = errors(0.0)
        gain = without - errors(predicted)
        chance = OPTIONS.min_gain_errors * gain.std(ddof=1) / np.sqrt(len(gain))
        tested, squares = np.any([parts.held_out for _, parts in blocks], axis=0), np.square(values - predicted)
        near = _nearness(scaled, order.outputs[: len(rich.a)], blocks)
        variances = few.predict(blocks)[1]
        open_ = few.beyond * near
        variances -= _taken(variances + shape.noise - squares, open_, tested) * open_
        stretch = max(0.01, float(np.mean((squares / (variances + shape.noise))[tested])))
        own = stretch * shape.noise
        variance = max(stretch * shape.variance, noise - own)
        few = KnownSums.of(few.features * np.sqrt(variance / shape.variance), variance, own / weights, values)
        variances = few.predict(blocks)[1]

        def fitted(sums: KnownSums, mean: Array) -> MeanFit:
            error = float(errors(mean).mean() / without.mean()) if without.any() else 1.0
            open_ = few.beyond * _nearness(scaled, order.outputs[: len(sums.a)], blocks)
            return MeanFit(sums, error, _taken(variances + own - np.square(values - mean), open_, tested))

        best, quick = fitted(rich, predicted), fitted(fast, quickly)
        gains = bool(gain.mean() > max(OPTIONS.min_gain * without.mean(), chance))
        held_out = np.stack([predicted, variances - best.taken * few.beyond * near])
        return cls(scaled, order, shape, best, quick, few, held_out, gains, variance, own)

    def residual(self) -> JointResidual:
        """Return the residual."""
        count, few = len(self.rich.sums.a), len(self.few.a)
        root = self.order.lower[self.order.outputs[:count], :count]
        weights, fast_weights = (
            np.sqrt(self.shape.variance) * solve_lower(root[: len(each.a), : len(each.a)], each.mean(), transposed=True)
            for each in (self.rich.sums, self.fast.sums)
        )
        return JointResidual(
            self.shape.lengthscales,
            self.scaled[self.order.outputs[:count]],
            weights,
            np.sqrt(self.variance) * solve_lower_right(np.eye(few), root[:few, :few]),
            self.variance,
            self.rich.taken,
            fast_weights,
            self.fast.taken,
        )


def _nearness(scaled: Array, centres: Indices, blocks: Sequence[tuple[slice, SplitRows]]) -> Array:
    """Return the largest squared correlation of N samples with a centre that is not held out with them, (N,).

    scaled: inputs in lengthscales, (N, D); centres: their places among the samples.
    """
    out = np.empty(len(scaled))
    for block, parts in blocks:
        others = scaled[centres[parts.train[centres]]]
        out[block] = np.exp(-cdist(scaled[block], others, "sqeuclidean").min(axis=1, initial=np.inf))
    return out


def _taken(excess: Array, open_: Array, tested: NDArray[np.bool_]) -> float:
    """Return the share of `open_` by which variances exceed squared errors, 0 to 1, over the tested of N samples.

    excess: variances minus squared errors, (N,); open_: what features leave, times nearness, (N,).
    """
    most = float(open_[tested].mean())
    return min(max(float(excess[tested].mean()) / most, 0.0), 1.0) if most > 0 else 0.0

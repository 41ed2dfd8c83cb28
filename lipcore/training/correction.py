"""A local correction of an arm: the arm's residual, if another part of the recording predicts it.

The residual of an arm lasts: it is the same near a sample, whether or not the arm returns there. So blocks of the
recording are held out in turn, with the instants next to them, and predicted from the others. A joint is corrected if
this reduces its error beyond chance. The arm does not change.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lipcore.data import metrics
from lipcore.data.independence import thinned_weights
from lipcore.data.metrics import LEVEL, quantile
from lipcore.data.motion import Indices, spaced_rows
from lipcore.data.samples import Array, Samples
from lipcore.data.splits import GUARD_S, SplitRows, apply_guard
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.residual import JointResidual, ResidualKernel, residual_inputs
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.conformal import Conformal, conformal_of
from lipcore.posterior.linalg import block_diagonal
from lipcore.training import lengthscales
from lipcore.training.lengthscales import fit_shapes
from lipcore.training.residual_fit import JointFit, learn_weights


@dataclass(frozen=True)
class CorrectionOptions:
    """Rows of a correction."""

    max_rows: int = 50_000
    """Max rows that its weights are learnt from."""
    max_candidates: int = 3000
    """Max rows that centres are chosen from."""
    max_shape_rows: int = 6000
    """Max rows that determine lengthscales."""
    part_weight: float = 300.0
    """Max effective samples of a part of the recording for this likelihood: if the parts are longer, no other part has
    similar motion. Tuned on a simulated Panda of 2200 s."""
    rows_each: float = 2.0
    """Max rows for each effective sample (`data.independence`)."""
    blocks: int = 10
    """Blocks that are held out in turn."""


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


def correct(
    arm: CompactPosterior, samples: Samples, before: ResidualKernel | None = None, max_rows: float = np.inf
) -> Correction:
    """Return a correction of an arm's residuals of N samples.

    before: correction by an earlier fit. Its joints are corrected in any case, and its lengthscales are the start;
    max_rows: max rows to learn. If the recording is too short for held-out blocks, no joint is corrected.
    """
    used, n = _used_rows(samples, max_rows), samples.n_joints
    noise, score = arm.noise_variance.copy(), np.zeros(used.tau.shape)
    errors, fast_errors = np.ones((2, n))
    found, blocks, conformal = [JointResidual.none(n)] * n, held_out_blocks(used), None
    sums = [np.zeros((0, 0))] * n
    if blocks:
        weights, inputs, known = thinned_weights(used.t), residual_inputs(used.motion()), arm.predict(used.motion())
        left = used.tau - known.mean
        earlier = [JointResidual.none(n)] * n if before is None else before.joints
        begin = [each.lengthscales if len(each.centres) else None for each in earlier]
        some = spaced_rows(len(used), OPTIONS.max_shape_rows)
        own = thinned_weights(used.t[some])
        parts = max(OPTIONS.blocks, round(float(weights.sum()) / OPTIONS.part_weight))
        part = np.arange(len(some)) * parts // len(some)
        shapes = fit_shapes(inputs[some], left[some], own, part, begin, _arm_of(arm))
        candidates = spaced_rows(len(used), OPTIONS.max_candidates)
        for j, shape in enumerate(shapes):
            if shape.gain < lengthscales.OPTIONS.min_gain_nats and begin[j] is None:
                continue
            fit = JointFit.of(inputs, left[:, j], weights, blocks, shape, float(noise[j]), candidates)
            if fit.gains or begin[j] is not None:
                found[j], noise[j], sums[j] = fit.residual(), fit.noise, fit.a
                errors[j], fast_errors[j] = min(fit.share(fit.rich), 1.0), fit.share(fit.fast)
                mean, variance = fit.held_out
                variance = variance + noise[j] + known.covariance[:, j, j]
                half = quantile(LEVEL) * np.sqrt(variance)
                score[:, j] = np.abs(left[:, j] - mean) / half
    conformal = conformal_of(score, metrics.blocks(used))
    return Correction(ResidualKernel(found), noise, block_diagonal(sums), errors, fast_errors, conformal)


def relearn_correction(arm: CompactPosterior, samples: Samples, before: ResidualKernel, noise: Array) -> Correction:
    """Return a correction by an earlier fit with weights learnt from samples; its centres and variances stay.

    noise: variance of the noise beside it, (n,) (N·m)². Errors are not estimated.
    """
    used = _used_rows(samples)
    weights, inputs = thinned_weights(used.t), residual_inputs(used.motion())
    left = used.tau - arm.mean(used.motion())
    found, sums = [], []
    for j, joint in enumerate(before.joints):
        learnt = learn_weights(joint, inputs, left[:, j], weights, float(noise[j])) if len(joint.centres) else None
        found.append(joint if learnt is None else learnt[0])
        sums.append(np.zeros((0, 0)) if learnt is None else learnt[1])
    unknown = np.ones(len(noise))
    return Correction(ResidualKernel(found), noise, block_diagonal(sums), unknown, unknown, None)


def _arm_of(posterior: CompactPosterior) -> Indices | None:
    arms = [each.arm for each in posterior.basis.linear if isinstance(each, ArmKernel)]
    return arms[0].arm_of if arms else None


def _used_rows(samples: Samples, max_rows: float = np.inf) -> Samples:
    """Return the rows that weights are learnt from, in order."""
    ordered = samples.rows(np.lexsort((samples.t, samples.episode)))
    count = min(OPTIONS.max_rows, max_rows, OPTIONS.rows_each * float(thinned_weights(ordered.t).sum()))
    return ordered.rows(spaced_rows(len(samples), max(2, round(count))))


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

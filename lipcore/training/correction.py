"""A local correction of an arm: the arm's residual, if another part of the recording predicts it.

The residual of an arm lasts: it is the same near a sample, whether or not the arm returns there. So blocks of the
recording are held out in turn, with the instants next to them, and predicted from the others. A joint is corrected if
this reduces its error beyond chance. The arm does not change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from lipcore.data.samples import Array, Samples
from lipcore.data.splits import GUARD_S, apply_guard
from lipcore.kernels.base import TorqueKernel
from lipcore.kernels.local import LocalKernel, nearness
from lipcore.posterior.basis import Basis
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.linalg import block_diagonal
from lipcore.posterior.selection import pivots
from lipcore.posterior.statistics import Statistics, collect


@dataclass(frozen=True)
class CorrectionOptions:
    """Evaluation of a correction, and its size."""

    max_rows: int = 1000
    """Max rows that are used."""
    blocks: int = 10
    """Blocks that are held out in turn."""
    noise_shares: tuple[float, ...] = (1e-3, 1e-2, 0.1, 0.3, 1.0)
    """Noise variances that are tried, as shares of the correction's variance."""
    min_gain: float = 0.2
    """Min gain of a corrected joint, as a share of its squared error."""
    min_gain_errors: float = 2.82
    """The same in standard errors: the 99 % point of t for ten blocks."""
    max_outputs: int = 400
    """Max torques at which the correction is stored."""
    open_share: float = 0.01
    """Max share of the correction's variance that these torques do not explain."""


OPTIONS = CorrectionOptions()
REPORT_PREFIX = "local_"
"""Prefix of entries of a fit's report, one for each corrected joint: the remaining share of its squared error."""


@dataclass(frozen=True)
class Correction:
    """A correction and its gain."""

    posterior: CompactPosterior
    """Posterior of arm and correction."""
    errors: Array
    """Squared error of held-out blocks with the correction, divided by that without, (n,); 1 for joints without
    correction."""

    def report(self) -> dict[str, float]:
        """Return the errors of corrected joints, for the manifest."""
        return {f"{REPORT_PREFIX}{j + 1}": round(float(each), 3) for j, each in enumerate(self.errors) if each < 1}


def corrected_joints(report: Mapping[str, object]) -> list[int]:
    """Return the corrected joints of a fit's report, from 0."""
    return [int(key.removeprefix(REPORT_PREFIX)) - 1 for key in report if key.startswith(REPORT_PREFIX)]


def correct(kernel: TorqueKernel, arm: CompactPosterior, samples: Samples, joints: Sequence[int] = ()) -> Correction:
    """Return the posterior of an arm with a correction of its residuals of N samples.

    kernel: the arm's, friction and the local one; joints: joints to correct in any case, as an earlier fit did. The
    noise of a corrected joint is its residual in held-out blocks. If the recording is too short for held-out blocks, no
    joint is corrected.
    """
    order = np.lexsort((samples.t, samples.episode))
    samples = samples.rows(
        order[np.unique(np.linspace(0, len(samples) - 1, OPTIONS.max_rows).round().astype(np.int64))]
    )
    motion, n = samples.motion(), samples.n_joints
    left = samples.tau - arm.mean(motion)
    local = LocalKernel(n)
    own = local.initial(motion, left)
    power, near = np.exp(own["local.log_scale"]), nearness(own, motion)
    with_it, without = _errors(samples, left / np.sqrt(power), near)
    best = with_it.mean(axis=0).argmin(axis=0)
    gain = without - with_it[:, best, np.arange(n)]
    error, chance = without.mean(axis=0), OPTIONS.min_gain_errors * gain.std(axis=0, ddof=1) / np.sqrt(len(gain))
    corrected = (gain.mean(axis=0) > np.maximum(OPTIONS.min_gain * error, chance)) | np.isin(np.arange(n), joints)
    errors = np.ones(n)
    errors[corrected] = np.minimum(1 - gain.mean(axis=0)[corrected] / error[corrected], 1.0)
    own["local.log_scale"] = np.log(np.where(corrected, 1.0, 1e-12) * power)
    params = {**arm.params, **own, "noise.log_std": arm.params["noise.log_std"] + 0.5 * np.log(errors)}
    kept = arm.basis.inducing
    if corrected.any():
        kept = motion[np.sort(pivots(near, 1, OPTIONS.max_outputs // int(corrected.sum()), OPTIONS.open_share).outputs)]
    outputs = (np.arange(len(kept))[:, None] * n + np.flatnonzero(corrected)).reshape(-1)
    taught = collect(Basis.build(local, own, kept, outputs), np.array(OPTIONS.noise_shares)[best] * power, motion, left)
    assert arm.statistics is not None  # a trained posterior has statistics
    posterior = CompactPosterior.build(
        kernel,
        Basis.build(kernel, params, kept, outputs),
        side_by_side(taught, arm.statistics),
        arm.noise_variance * errors,
        arm.std_factor,
        arm.misfit,
    )
    return Correction(posterior, errors)


def side_by_side(correction: Statistics, arm: Statistics) -> Statistics:
    """Return the joint statistics of a correction and an arm that are independent."""
    a, b = block_diagonal([correction.a, arm.a]), np.concatenate([correction.b, arm.b])
    return Statistics(a, b, arm.samples)


def _errors(samples: Samples, left: Array, near: Array) -> tuple[Array, Array]:
    """Return the mean squared errors of B blocks predicted from the others, with and without a correction.

    With a correction they are (B, S, n) for S noise shares, without it (B, n). All are one if a block is too short.
    samples: in order; left: (N, n), in units of its root mean square; near: (N, N).
    """
    block = np.arange(len(samples)) * OPTIONS.blocks // len(samples)
    with_it, without = [], []
    for each in range(OPTIONS.blocks):
        parts = apply_guard(samples.episode, samples.t, np.arange(len(samples)), block == each, GUARD_S)
        if not (parts.train.any() and parts.held_out.any()):
            return np.ones((2, len(OPTIONS.noise_shares), left.shape[1])), np.ones((2, left.shape[1]))
        values, vectors = eigh(near[np.ix_(parts.train, parts.train)])
        turned, across = vectors.T @ left[parts.train], near[np.ix_(parts.held_out, parts.train)] @ vectors
        asked = left[parts.held_out]
        answers = [across @ (turned / (values.clip(0.0) + share)[:, None]) for share in OPTIONS.noise_shares]
        with_it.append([np.square(asked - answer).mean(axis=0) for answer in answers])
        without.append(np.square(asked).mean(axis=0))
    return np.array(with_it), np.array(without)

"""Statistics of very many samples, fast and in constant memory. They equal `statistics.collect`, to rounding.

On the CPU, with a thousand variables and seven joints, three steps use nearly all of the time. The Gram matrix is
compiled. The triangular solve is done in place for all torques of a chunk. The product of the features with themselves
is added to the sum by BLAS's `syrk`, which computes one triangle only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from lipcore.data.motion import Motion
from lipcore.data.samples import Array, Samples
from lipcore.kernels.base import TorqueKernel
from lipcore.kernels.fast.compile import compiled
from lipcore.posterior.basis import Basis
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.linalg import add_square_of_rows, pack_symmetric, whiten_rows
from lipcore.posterior.misfit import Misfit
from lipcore.vocabulary import Device

if TYPE_CHECKING:
    from lipcore.posterior.on_device import DeviceBasis

CHUNK = 1024
"""Samples of one matrix product. Larger chunks read and write the sum less often."""
PIECE = 256
"""Samples per computation of features."""


@dataclass
class Total:
    """A running sum: the upper triangle of A, (M, M), and b, (M,)."""

    a: Array
    b: Array

    @classmethod
    def empty(cls, size: int) -> Total:
        """Return the sum of no samples, for M = size variables."""
        return cls(np.zeros((size, size)), np.zeros(size))

    def packed(self) -> Array:
        """Return the upper triangle of A row by row, (M (M + 1) / 2,)."""
        return pack_symmetric(self.a)


@dataclass(frozen=True)
class Summing:
    """Summation of samples for a posterior, with its kernel, basis, noise and misfit.

    device: computes everything except the sum; a GPU for `se`, `gip` and `lse` alone.
    """

    kernel: TorqueKernel
    basis: Basis
    noise_variance: Array
    misfit: Misfit
    device: Device

    @classmethod
    def of(cls, posterior: CompactPosterior, device: Device = "cpu") -> Summing:
        """Return the summation for a posterior, on a device."""
        return cls(posterior.kernel, posterior.basis, posterior.noise_variance, posterior.row_misfit, device)

    def add(self, total: Total, samples: Samples, weights: Array | None = None) -> None:
        """Add samples to a total. weights: (N,), one for each sample, None for all one."""
        scale = np.ones(len(samples)) if weights is None else np.ascontiguousarray(weights, np.float64)
        on_cpu = self.device == "cpu"
        features = self._on_cpu(total, samples, scale) if on_cpu else self._elsewhere(total, samples, scale)
        add_square_of_rows(total.a, features)

    def _on_cpu(self, total: Total, samples: Samples, weights: Array) -> Array:
        """Return the weighed features of N samples' torques, (N n, M), piece by piece: a piece stays in the cache."""
        n, first = samples.n_joints, len(self.basis.outputs)
        out = np.empty((len(samples) * n, len(self.basis)))
        for start in range(0, len(samples), PIECE):
            part = slice(start, start + PIECE)
            motion = samples.rows(part).motion()
            residual = np.ascontiguousarray(samples.tau[part] - self.kernel.mean(motion))
            noise = self.misfit.of_row(self.noise_variance, motion)
            piece = out[start * n : (start + len(motion)) * n]
            self._features(motion, piece)
            weigh(piece, first, self.basis.prior(motion), noise, weights[part], residual, total.b)
        return out

    def _features(self, motion: Motion, out: Array) -> None:
        """Write φ of the torques of N samples, (N n, M)."""
        basis, first = self.basis, len(self.basis.outputs)
        if basis.term is not None:
            gram = basis.term.gram(basis.params, motion, basis.inducing)
            chosen = np.take(gram, basis.outputs, axis=1, mode="clip")
            whiten_rows(basis.root[:first, :first], chosen)
            out[:, :first] = chosen
        for each in basis.linear:
            rows = each.flat_features(motion)
            columns = slice(first, first + rows.shape[1])
            np.multiply(rows, basis.scales[columns], out=out[:, columns])
            first = columns.stop

    def _elsewhere(self, total: Total, samples: Samples, weights: Array) -> Array:
        motion = samples.motion()
        noise = self.misfit.of_row(self.noise_variance, motion)
        features, more = self._moved.weighed(motion, samples.tau - self.kernel.mean(motion), noise, weights)
        total.b += more
        return features

    @cached_property
    def _moved(self) -> DeviceBasis:
        from lipcore.posterior.on_device import DeviceBasis  # noqa: PLC0415 - it imports torch

        return DeviceBasis(self.basis, self.device)


@compiled
def weigh(
    features: Array, inducing: int, prior: Array, noise: Array, weights: Array, residual: Array, b: Array
) -> None:
    """Scale the features φ of N samples' torques by the square root of their precision, and add Σ φ R⁻¹ residual to b.

    R is the noise plus the prior variance that the first `inducing` features do not explain, see
    `statistics.Statistics`. features: (N n, M), in place; prior: (N, n) variances of the nonlinear term; noise: (N, n);
    weights: (N,); residual: (N, n); b: (M,).
    """
    count, n = prior.shape
    size = features.shape[1]
    for sample in range(count):
        for joint in range(n):
            row = features[sample * n + joint]
            explained = 0.0
            for k in range(inducing):
                explained += row[k] * row[k]
            precision = weights[sample] / (noise[sample, joint] + max(prior[sample, joint] - explained, 0.0))
            root = np.sqrt(precision)
            weighed = precision * residual[sample, joint]
            for k in range(size):
                b[k] += weighed * row[k]
                row[k] *= root

"""Statistics of very many samples, fast and in memory that does not grow: those of `statistics.collect`, to rounding.

Profiled for a thousand variables and seven joints on the CPU: the Gram matrix, the triangular solve and the product of
the features with themselves are nearly all that is left. The first is compiled; the second is done in place for all
torques of a chunk; the third adds to the sum by BLAS's `syrk`, which computes one triangle only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from lipcore.data.motion import Motion
from lipcore.data.samples import Array, Samples
from lipcore.kernels.base import PairKernel, Params, TorqueKernel
from lipcore.kernels.compiled.compile import compiled
from lipcore.posterior.basis import Basis
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.misfit import Misfit

CHUNK = 1024
"""Samples whose product is computed together: the more, the less often the sum is read and written."""
PIECE = 256
"""Samples whose features are computed together."""


@dataclass
class Total:
    """A sum that grows: the lower triangle of A, (M, M) in Fortran's order, and b, (M,)."""

    a: Array
    b: Array

    @classmethod
    def empty(cls, size: int) -> Total:
        """The sum of no samples, for M = size variables."""
        return cls(torch.zeros((size, size), dtype=torch.float64).numpy().T, np.zeros(size))

    def packed(self) -> Array:
        """Upper triangle of A row by row, (M (M + 1) / 2,)."""
        rows, columns = np.triu_indices(len(self.a))
        packed: Array = self.a[columns, rows]
        return packed


@dataclass(frozen=True)
class Summing:
    """How samples are summed up for a posterior: its kernel, basis, noise and misfit.

    On a device other than the CPU, torch does all but the sum.
    """

    kernel: TorqueKernel
    basis: Basis
    noise_variance: Tensor
    misfit: Misfit
    device: torch.device
    prior: Callable[[Motion], Array] = field(repr=False)

    @classmethod
    def of(cls, posterior: CompactPosterior, device: torch.device | str = "cpu") -> Summing:
        """For a posterior, on a device."""
        basis, place = posterior.basis, torch.device(device)
        prior = _nothing if basis.term is None else _prior(basis.term, basis.params, basis.inducing)
        if place.type != "cpu":
            basis = _moved(basis, place)
        misfit = Misfit.unpacked(posterior.misfit.packed().to(place))
        return cls(posterior.kernel, basis, posterior.noise_variance.to(place), misfit, place, prior)

    def add(self, total: Total, samples: Samples, weights: Array | None = None) -> None:
        """Add samples to a total. weights: (N,), one for each, all equal where None."""
        from scipy.linalg.blas import dsyrk  # noqa: PLC0415 - serving does without it

        scale = np.ones(len(samples)) if weights is None else np.ascontiguousarray(weights, np.float64)
        features = (
            self._on_cpu(total, samples, scale) if self.device.type == "cpu" else self._elsewhere(total, samples, scale)
        )
        # in place: `a` is in Fortran's order, and so are the features' transpose
        dsyrk(1.0, features.T, beta=1.0, c=total.a, lower=1, overwrite_c=1)

    def _on_cpu(self, total: Total, samples: Samples, weights: Array) -> Array:
        """Weighed features of the torques of N samples, (N n, M), piece by piece: a piece stays in the cache."""
        n, first = samples.n_joints, len(self.basis.outputs)
        # memory of torch: BLAS rounds in another order where memory is aligned otherwise, as that of NumPy may be
        out = torch.empty((len(samples) * n, len(self.basis)), dtype=torch.float64).numpy()
        for start in range(0, len(samples), PIECE):
            part = slice(start, start + PIECE)
            motion = Motion(*(torch.from_numpy(each[part]) for each in (samples.q, samples.dq, samples.ddq)))
            residual = np.ascontiguousarray(samples.tau[part] - self.kernel.mean(motion).numpy())
            noise = self.misfit.of_row(self.noise_variance, motion.dq).numpy()
            piece = out[start * n : (start + len(motion)) * n]
            self._features(motion, piece)
            weigh(piece, first, self.prior(motion), noise, weights[part], residual, total.b)
        return out

    def _features(self, motion: Motion, out: Array) -> None:
        """Write φ of the torques of N samples, (N n, M)."""
        basis, first = self.basis, len(self.basis.outputs)
        if basis.term is not None:
            gram = basis.term.gram(basis.params, motion, basis.inducing).numpy()
            np.take(gram, basis.outputs.numpy(), axis=1, out=out[:, :first], mode="clip")
        for each in basis.linear:
            features, covariance = each.features(motion).clone(), each.covariance(basis.params)
            columns = slice(first, first + len(covariance))
            out[:, columns] = (features.reshape(-1, features.shape[-1]) @ covariance).numpy()
            first = columns.stop
        solved = torch.from_numpy(out).T
        torch.linalg.solve_triangular(basis.root, solved, upper=False, out=solved)

    def _elsewhere(self, total: Total, samples: Samples, weights: Array) -> Array:
        motion, scale = samples.motion(self.device), torch.from_numpy(weights.copy()).to(self.device)
        residual = samples.torque(self.device) - self.kernel.mean(motion)
        features = self.basis.features(motion)
        variance = self.misfit.of_row(self.noise_variance, motion.dq) + self.basis.uncovered(motion, features)
        root = (scale[:, None] / variance).sqrt()
        features *= root.reshape(-1)
        total.b += (features @ (residual * root).reshape(-1)).cpu().numpy()
        return np.ascontiguousarray(features.T.cpu().numpy())


def _prior(term: PairKernel, params: Params, inducing: Motion) -> Callable[[Motion], Array]:
    """Prior variances of a term's torques, (N, n): compiled, as a by-product of meeting one inducing sample."""
    cross = term.cross(params, inducing[:1])

    def variances(motion: Motion) -> Array:
        motions = np.stack([motion.q.numpy(), motion.dq.numpy(), motion.ddq.numpy()], axis=1)
        blocks = np.empty((len(motion), 2, motion.n_joints, motion.n_joints))
        cross.fill_many(np.ascontiguousarray(motions), blocks)
        return np.ascontiguousarray(blocks[:, 1].diagonal(axis1=1, axis2=2))

    return variances


def _nothing(motion: Motion) -> Array:
    """The linear terms' own features leave nothing open."""
    return np.zeros(tuple(motion.q.shape))


def _moved(basis: Basis, device: torch.device) -> Basis:
    params = {name: value.to(device) for name, value in basis.params.items()}
    inducing, outputs = basis.inducing.to(device), basis.outputs.to(device)
    return Basis(basis.term, basis.linear, params, inducing, outputs, basis.root.to(device))


@compiled
def weigh(
    features: Array, inducing: int, prior: Array, noise: Array, weights: Array, residual: Array, b: Array
) -> None:
    """Scale the features φ of N samples' torques by the square root of their precision, and add Σ φ R⁻¹ residual to b.

    R is the noise and what of the prior variance the first `inducing` features leave open, see `statistics.Statistics`.
    features: (N n, M), in place; prior: (N, n) variances of the nonlinear term; noise: (N, n); weights: (N,);
    residual: (N, n); b: (M,).
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

"""The fit of `se`, `gip` and `lse`, and sums over very many samples, on a GPU. Results equal the CPU's, to rounding.

The kernel's formula is computed on the GPU. The features of friction are copied to it.
"""

from __future__ import annotations

from math import log, pi

import torch
from torch import Tensor

from lipcore.data.motion import Array, Motion
from lipcore.kernels.base import Params, TorqueKernel
from lipcore.kernels.differentiation import gradient, motion_on, params_on, tensor
from lipcore.posterior.basis import Basis, split
from lipcore.posterior.linalg import JITTERS, NotPositiveDefiniteError


def evidence_on(
    kernel: TorqueKernel, params: Params, motion: Motion, tau: Array, device: str
) -> tuple[float, dict[str, Array]]:
    """Return −log evidence, nats, and its gradient. Arguments: see `exact.negative_log_evidence`."""
    term, linear = split(kernel)
    assert term is not None
    n, size, noise = kernel.n_joints, len(motion), tensor(params["noise.log_std"], device)
    variance = torch.exp(2 * noise)
    features = [(each, tensor(each.flat_features(motion), device)) for each in linear]
    gram = tensor(term.symmetric_gram(params_on(params, device), motion_on(motion, device)), device)  # type: ignore[arg-type]
    for each, rows in features:
        gram += (rows * tensor(each.variances(params), device)) @ rows.T
    gram.diagonal().add_(variance.repeat(size))
    lower = _lower(gram)
    y = tensor(tau - kernel.mean(motion), device).reshape(-1)
    alpha = torch.cholesky_solve(y[:, None], lower)[:, 0]
    value = 0.5 * (y @ alpha) + lower.diagonal().log().sum() + 0.5 * len(y) * log(2 * pi)
    weight = 0.5 * (torch.cholesky_inverse(lower) - torch.outer(alpha, alpha))
    slopes = gradient(term, params, motion, weight)
    for each, rows in features:
        slopes |= each.variances_adjoint(params, torch.einsum("ik,ik->k", rows, weight @ rows).cpu().numpy())
    slopes["noise.log_std"] = (2 * variance * weight.diagonal().reshape(size, n).sum(0)).cpu().numpy()
    return float(value), slopes


class DeviceBasis:
    """A basis on a device. See `Basis.features` and `Basis.uncovered`."""

    def __init__(self, basis: Basis, device: str) -> None:
        assert basis.term is not None
        self._basis, self._term, self._device = basis, basis.term, device
        self._params, self._inducing = params_on(basis.params, device), motion_on(basis.inducing, device)
        self._outputs = torch.as_tensor(basis.outputs, device=device)
        self._root, self._scales = tensor(basis.root, device), tensor(basis.scales, device)

    def weighed(self, motion: Motion, residual: Array, noise: Array, weights: Array) -> tuple[Array, Array]:
        """Return the features of N samples' torques times their root precision, (N n, M), and Σ φ R⁻¹ residual, (M,).

        residual, noise: (N, n); weights: (N,).
        """
        basis, rows = self._basis, motion_on(motion, self._device)
        features = torch.empty((len(basis), residual.size), dtype=torch.float64, device=self._device)
        first = len(basis.outputs)
        gram = tensor(self._term.gram(self._params, self._inducing, rows), self._device)  # type: ignore[arg-type]
        root = self._root[:first, :first]
        features[:first] = torch.linalg.solve_triangular(root, gram[self._outputs], upper=False)
        prior = tensor(self._term.variance(self._params, rows), self._device).diagonal(dim1=1, dim2=2)  # type: ignore[arg-type]
        explained = features[:first].square().sum(0).reshape(prior.shape)
        variance = tensor(noise, self._device) + (prior - explained).clamp_min(0.0)
        for each in basis.linear:
            part = tensor(each.flat_features(motion).T, self._device)
            features[first : first + len(part)] = part * self._scales[first : first + len(part), None]
            first += len(part)
        precision = (tensor(weights, self._device)[:, None] / variance).sqrt().reshape(-1)
        features *= precision
        total = features @ (tensor(residual, self._device).reshape(-1) * precision)
        return features.T.contiguous().cpu().numpy(), total.cpu().numpy()


def _lower(gram: Tensor) -> Tensor:
    """Return the Cholesky factor by the project's jitter policy, see `linalg.cholesky`."""
    scale = float(gram.diagonal().mean())
    for relative in JITTERS:
        shifted = gram if relative == 0.0 else gram + relative * scale * torch.eye(len(gram), device=gram.device)
        lower, failed = torch.linalg.cholesky_ex(shifted)
        if not int(failed):
            return torch.as_tensor(lower)
    raise NotPositiveDefiniteError(f"covariance matrix of size {len(gram)} is not positive definite")

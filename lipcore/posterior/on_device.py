"""What a fit and sums over very many samples compute on a GPU, by PyTorch: the same as on the CPU, to rounding.

Formulas of the nonlinear terms are computed there; features of linear ones, which are compiled, are moved there.
"""

from __future__ import annotations

from math import log, pi

import torch
from torch import Tensor

from lipcore.data.motion import Array, Motion
from lipcore.kernels.base import LinearKernel, PairKernel, Params, SumKernel, TorqueKernel
from lipcore.kernels.differentiation import gradient, motion_on, params_on, tensor
from lipcore.posterior.basis import Basis
from lipcore.posterior.linalg import JITTERS, NotPositiveDefiniteError


def evidence_on(
    kernel: TorqueKernel, params: Params, motion: Motion, tau: Array, device: str
) -> tuple[float, dict[str, Array]]:
    """−log evidence, nats, and its gradient: see `exact.negative_log_evidence`, whose arguments these are."""
    n, size, noise = kernel.n_joints, len(motion), tensor(params["noise.log_std"], device)
    variance = torch.exp(2 * noise)
    gram = _gram(kernel, params, motion, device)
    gram.diagonal().add_(variance.repeat(size))
    lower = _lower(gram)
    y = tensor(tau - kernel.mean(motion), device).reshape(-1)
    alpha = torch.cholesky_solve(y[:, None], lower)[:, 0]
    value = 0.5 * (y @ alpha) + lower.diagonal().log().sum() + 0.5 * len(y) * log(2 * pi)
    weight = 0.5 * (torch.cholesky_inverse(lower) - torch.outer(alpha, alpha))
    slopes: dict[str, Array] = {}
    for term in kernel.terms if isinstance(kernel, SumKernel) else (kernel,):
        if isinstance(term, PairKernel):
            slopes |= gradient(term, params, motion, weight)
        elif isinstance(term, LinearKernel):
            rows = tensor(term.flat_features(motion), device)
            slopes |= term.variances_adjoint(params, torch.einsum("ik,ik->k", rows, weight @ rows).cpu().numpy())
    slopes["noise.log_std"] = (2 * variance * weight.diagonal().reshape(size, n).sum(0)).cpu().numpy()
    return float(value), slopes


class DeviceBasis:
    """A basis on a device. See `Basis.features` and `Basis.uncovered`."""

    def __init__(self, basis: Basis, device: str) -> None:
        self._basis, self._device = basis, device
        self._params, self._inducing = params_on(basis.params, device), motion_on(basis.inducing, device)
        self._outputs = torch.as_tensor(basis.outputs, device=device)
        self._root, self._scales = tensor(basis.root, device), tensor(basis.scales, device)

    def weighed(self, motion: Motion, residual: Array, noise: Array, weights: Array) -> tuple[Array, Array]:
        """Features of N samples' torques, (N n, M), times the root of their precision, and Σ φ R⁻¹ residual, (M,).

        residual, noise: (N, n); weights: (N,).
        """
        basis, rows = self._basis, motion_on(motion, self._device)
        features = torch.empty((len(basis), residual.size), dtype=torch.float64, device=self._device)
        variance, first = tensor(noise, self._device), len(basis.outputs)
        if basis.term is not None:
            gram = tensor(basis.term.gram(self._params, self._inducing, rows), self._device)  # type: ignore[arg-type]
            features[:first] = torch.linalg.solve_triangular(
                self._root[:first, :first], gram[self._outputs], upper=False
            )
            prior = tensor(basis.term.variance(self._params, rows), self._device).diagonal(dim1=1, dim2=2)  # type: ignore[arg-type]
            explained = features[:first].square().sum(0).reshape(prior.shape)
            variance = variance + (prior - explained).clamp_min(0.0)
        for each in basis.linear:
            part = tensor(each.flat_features(motion).T, self._device)
            features[first : first + len(part)] = part * self._scales[first : first + len(part), None]
            first += len(part)
        root = (tensor(weights, self._device)[:, None] / variance).sqrt().reshape(-1)
        features *= root
        total = features @ (tensor(residual, self._device).reshape(-1) * root)
        return features.T.contiguous().cpu().numpy(), total.cpu().numpy()


def _gram(kernel: TorqueKernel, params: Params, motion: Motion, device: str) -> Tensor:
    if isinstance(kernel, SumKernel):
        return torch.stack([_gram(term, params, motion, device) for term in kernel.terms]).sum(0)
    if isinstance(kernel, LinearKernel):
        rows = tensor(kernel.flat_features(motion), device)
        gram = (rows * tensor(kernel.variances(params), device)) @ rows.T
        return 0.5 * (gram + gram.T)
    return tensor(kernel.symmetric_gram(params_on(params, device), motion_on(motion, device)), device)  # type: ignore[arg-type]


def _lower(gram: Tensor) -> Tensor:
    """Cholesky factor by the project's jitter policy, see `linalg.cholesky`."""
    scale = float(gram.diagonal().mean())
    for relative in JITTERS:
        shifted = gram if relative == 0.0 else gram + relative * scale * torch.eye(len(gram), device=gram.device)
        lower, failed = torch.linalg.cholesky_ex(shifted)
        if not int(failed):
            return torch.as_tensor(lower)
    raise NotPositiveDefiniteError(f"covariance matrix of size {len(gram)} is not positive definite")

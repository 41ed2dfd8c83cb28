"""Pair kernels with a compiled twin: used on the CPU, held to the torch form by tests."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lipcore.data.motion import Motion
from lipcore.kernels.base import PairKernel, Params

Array = NDArray[np.float64]


class CompiledKernel(PairKernel):
    """A pair kernel whose Gram matrices and gradients are compiled; on devices other than the CPU torch does it all."""

    @abstractmethod
    def compiled_gram(self, params: Params, x: Motion, y: Motion, symmetric: bool) -> Array:
        """Gram matrix (N, n, M, n)."""

    @abstractmethod
    def compiled_gradient(self, leaves: Params, x: Motion, weight: Array) -> Tensor:
        """Scalar whose derivatives by `leaves` are those of Σ weight ∘ gram(x, x); weight: (N, n, N, n), symmetric."""

    def gram(self, params: Params, x: Motion, y: Motion) -> Tensor:
        """Covariance of all torques of x with all of y: (N n, M n)."""
        if x.device.type != "cpu":
            return super().gram(params, x, y)
        return self._flat(self.compiled_gram(params, x, y, symmetric=False))

    def symmetric_gram(self, params: Params, x: Motion) -> Tensor:
        """Covariance of all torques of x with each other, (N n, N n), exactly symmetric."""
        if x.device.type != "cpu":
            return super().symmetric_gram(params, x)
        return self._flat(self.compiled_gram(params, x, x, symmetric=True))

    def gradient(self, params: Params, x: Motion, weight: Tensor) -> dict[str, Tensor]:
        """Derivative of Σ weight ∘ gram(x, x) by each hyperparameter."""
        if x.device.type != "cpu":
            return super().gradient(params, x, weight)
        n, size = self.n_joints, len(x)
        leaves = {name: params[name].detach().clone().requires_grad_(True) for name in self.names()}
        by_sample = weight.contiguous().reshape(size, n, size, n).numpy()
        self.compiled_gradient(leaves, x, by_sample).backward()  # type: ignore[no-untyped-call]
        return {name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for name, leaf in leaves.items()}

    def _flat(self, gram: Array) -> Tensor:
        rows, columns = gram.shape[0] * self.n_joints, gram.shape[2] * self.n_joints
        return torch.from_numpy(gram).reshape(rows, columns)


def arrays(motion: Motion) -> tuple[Array, Array, Array]:
    """q, dq and ddq as C-contiguous arrays (N, n): another layout would be compiled anew."""
    q, dq, ddq = (np.ascontiguousarray(part.numpy()) for part in (motion.q, motion.dq, motion.ddq))
    return q, dq, ddq


def inner(tensors: list[Tensor], derivatives: list[Array | float]) -> Tensor:
    """Σ tensor · derivative: carries derivatives by kernel arguments on to the hyperparameters they come from."""
    parts = [
        (tensor * torch.as_tensor(derivative, dtype=tensor.dtype)).sum()
        for tensor, derivative in zip(tensors, derivatives, strict=True)
    ]
    return torch.stack(parts).sum()

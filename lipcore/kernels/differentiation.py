"""Derivatives of pair kernels by PyTorch. Only fitting needs them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from lipcore.data.motion import Array, Motion
from lipcore.kernels.base import State, row_chunks

if TYPE_CHECKING:
    from lipcore.kernels.base import PairKernel, Params


def tensor(values: Array | Tensor, device: torch.device | str = "cpu") -> Tensor:
    """Return an array as a tensor on a device."""
    return torch.as_tensor(values, dtype=torch.float64, device=device)


def motion_on(motion: Motion, device: torch.device | str) -> Motion:
    """Return a motion with tensors on a device as arrays, for the formulas of `PairKernel`."""
    parts = (tensor(each, device) for each in (motion.q, motion.dq, motion.ddq))
    return Motion(*parts)  # type: ignore[arg-type]


def params_on(params: Params, device: torch.device | str) -> Mapping[str, Tensor]:
    """Return hyperparameters as tensors on a device."""
    return {name: tensor(value, device) for name, value in params.items()}


def gradient(kernel: PairKernel, params: Params, x: Motion, weight: Array | Tensor) -> dict[str, Array]:
    """Return the derivative of Σ weight ∘ gram(x, x) by each hyperparameter, computed on the device of the weight.

    x: N samples; weight: symmetric, (N n, N n). The pairs of samples are differentiated in small chunks. Memory is that
    of one Gram matrix: its derivatives are never stored.
    """
    weights = torch.as_tensor(weight)
    n, size, device = kernel.n_joints, len(x), weights.device
    motion = motion_on(x, device)
    leaves = {name: tensor(params[name], device).clone().requires_grad_(True) for name in kernel.names()}
    by_sample = weights.reshape(size, n, size, n)
    for rows in row_chunks(size, size):
        # pairs below the chunk's diagonal block are the transposes of those above it: the factor two counts them
        columns = slice(rows.start, size)
        blocks = kernel.blocks(leaves, State.rows(motion[rows]), State.columns(motion[columns]))  # type: ignore[arg-type]
        part = 2.0 * by_sample[rows, :, columns].permute(1, 3, 0, 2)
        part[..., : rows.stop - rows.start] *= 0.5
        torch.autograd.backward((part * torch.as_tensor(blocks)).sum())
    slopes = ((name, leaf, leaf.grad) for name, leaf in leaves.items())
    return {name: (torch.zeros_like(leaf) if grad is None else grad).cpu().numpy() for name, leaf, grad in slopes}

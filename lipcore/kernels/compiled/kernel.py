"""Kernels with compiled code for the CPU, and their covariances with one query."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lipcore.data.motion import Motion
from lipcore.kernels.base import Array, Cross, PairKernel, Params
from lipcore.kernels.compiled.joints import Flags, columns, read_rows
from lipcore.kernels.compiled.lanes import LANES
from lipcore.kernels.compiled.views import Memory
from lipcore.vocabulary import JointType


class Driver(NamedTuple):
    """The compiled functions of a kernel, as those of `chain`: their memory and what they take is said in `pairs`."""

    size: Callable[[int], int]
    gram: Callable[[Array, int, Array, bool, Array], None]
    gradient: Callable[[Array, int, Array, Array, Array], None]
    cross: Callable[[Array, int, Flags, Array, Array], None]


class CompiledKernel(PairKernel):
    """A pair kernel whose Gram matrices and gradients are compiled; on devices other than the CPU torch does it all."""

    driver: ClassVar[Driver]
    joint_types: tuple[JointType, ...]

    @abstractmethod
    def hyper(self, params: Params) -> tuple[Tensor, Tensor, Tensor]:
        """`pairs.Hyper`: shares (E, n, 3), scales (n,) and weights (n, n), differentiable in params."""

    def gram(self, params: Params, x: Motion, y: Motion) -> Tensor:
        """Covariance of all torques of x with all of y: (N n, M n)."""
        return super().gram(params, x, y) if x.device.type != "cpu" else self._gram(params, x, y, symmetric=False)

    def symmetric_gram(self, params: Params, x: Motion) -> Tensor:
        """Covariance of all torques of x with each other, (N n, N n), exactly symmetric."""
        if x.device.type != "cpu":
            return super().symmetric_gram(params, x)
        return self._gram(params, x, x, symmetric=True)

    def gradient(self, params: Params, x: Motion, weight: Tensor) -> dict[str, Tensor]:
        """Derivative of Σ weight ∘ gram(x, x) by each hyperparameter: compiled by `hyper`, from there on autograd's."""
        if x.device.type != "cpu":
            return super().gradient(params, x, weight)
        n, size = self.n_joints, len(x)
        leaves = {name: params[name].detach().clone().requires_grad_(True) for name in self.names()}
        hyper = self.hyper(leaves)
        rows = read_rows(x.arrays(), self._prismatic())
        memory = _memory(rows, hyper, self.driver.size(n))
        sums = np.zeros(LANES * sum(part.numel() for part in hyper))
        by_sample = weight.contiguous().reshape(size, n, size, n).numpy()
        self.driver.gradient(memory, len(hyper[0]), rows, by_sample, sums)
        derivatives = torch.from_numpy(sums.reshape(-1, LANES).sum(1))
        torch.dot(torch.cat([part.reshape(-1) for part in hyper]), derivatives).backward()  # type: ignore[no-untyped-call]
        return {name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for name, leaf in leaves.items()}

    def cross(self, params: Params, inducing: Motion) -> Cross:
        """Covariance of one query with the inducing samples and itself, for serving."""
        return CompiledCross(self.driver, self.hyper(params), self._prismatic(), inducing)

    def _gram(self, params: Params, x: Motion, y: Motion, symmetric: bool) -> Tensor:
        n, hyper, prismatic = self.n_joints, self.hyper(params), self._prismatic()
        rows = read_rows(x.arrays(), prismatic)
        others = rows if symmetric else read_rows(y.arrays(), prismatic)
        out = np.empty((len(x), n, len(y), n))
        self.driver.gram(_memory(others, hyper, self.driver.size(n)), len(hyper[0]), rows, symmetric, out)
        return torch.from_numpy(out).reshape(len(x) * n, len(y) * n)

    def _prismatic(self) -> Flags:
        return np.array([kind == "prismatic" for kind in self.joint_types])


class CompiledCross(Cross):
    """`Cross` of a kernel with a driver. hyper: of `CompiledKernel.hyper`; prismatic: (n,)."""

    def __init__(
        self, driver: Driver, hyper: tuple[Tensor, Tensor, Tensor], prismatic: Flags, inducing: Motion
    ) -> None:
        self.size, self.n_joints = len(inducing), inducing.n_joints
        self._run, self._kernels, self._prismatic = driver.cross, len(hyper[0]), prismatic
        work = 6 * self.n_joints + driver.size(self.n_joints)
        self._memory = Memory([columns(read_rows(inducing.arrays(), prismatic), 1), *_arrays(hyper)], work)

    def fill(self, motion: Array, out: Array) -> None:
        """Write the covariances of one query."""
        self.fill_many(motion[None], out[None])

    def fill_many(self, motions: Array, out: Array) -> None:
        """Write the covariances of N queries."""
        self._run(self._memory.flat, self._kernels, self._prismatic, motions, out)


def _memory(others: Array, hyper: tuple[Tensor, Tensor, Tensor], work: int) -> Array:
    return Memory([columns(others, 0), *_arrays(hyper)], work).flat


def _arrays(hyper: tuple[Tensor, Tensor, Tensor]) -> list[Array]:
    return [part.detach().cpu().numpy() for part in hyper]

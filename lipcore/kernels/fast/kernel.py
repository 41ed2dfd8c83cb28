"""Pair kernels with compiled code for the CPU, and their covariances with single queries."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import numpy as np

from lipcore.data.motion import Array, Motion
from lipcore.kernels.base import Cross, PairKernel, Params
from lipcore.kernels.fast.joints import Flags, columns, read_rows
from lipcore.kernels.fast.lanes import LANES
from lipcore.kernels.fast.pairs import Hyper
from lipcore.kernels.fast.views import Memory
from lipcore.vocabulary import JointType


class Driver(NamedTuple):
    """Compiled functions of a kernel, for example those of `chain`. `pairs` documents their memory and arguments."""

    size: Callable[[int], int]
    gram: Callable[[Array, int, Array, bool, Array], None]
    gradient: Callable[[Array, int, Array, Array, Array], None]
    cross: Callable[[Array, int, Flags, Array, Array], None]


class CompiledKernel(PairKernel):
    """Pair kernel with compiled Gram matrices, gradients and query covariances. They equal its formula."""

    driver: ClassVar[Driver]
    joint_types: tuple[JointType, ...]

    @abstractmethod
    def hyper(self, params: Params) -> Hyper:
        """Return the hyperparameters for compiled code: shares (E, n, 3), scales (n,) and weights (n, n)."""

    @abstractmethod
    def hyper_adjoint(self, hyper: Hyper, slopes: Hyper) -> dict[str, Array]:
        """Return the derivatives by each hyperparameter. hyper: result of `hyper`; slopes: derivatives by it."""

    def gram(self, params: Params, x: Motion, y: Motion) -> Array:
        """Return the covariance of all torques of x with all torques of y, (N n, M n)."""
        return self._gram(params, x, y, symmetric=False)

    def symmetric_gram(self, params: Params, x: Motion) -> Array:
        """Return the covariance of all torques of x with each other, (N n, N n), exactly symmetric."""
        return self._gram(params, x, x, symmetric=True)

    def variance(self, params: Params, x: Motion) -> Array:
        """Return the prior covariance of the torques at each sample, (N, n, n), as `cross` computes it for a query."""
        cross = self.cross(params, x[:1])
        out = np.empty((len(x), cross.size + 1, self.n_joints, self.n_joints))
        cross.fill_many(x.arrays(), out)
        return out[:, -1]

    def gradient(self, params: Params, x: Motion, weight: Array) -> dict[str, Array]:
        """Return the derivative of Σ weight ∘ gram(x, x) by each hyperparameter.

        Compiled code differentiates by the result of `hyper`; `hyper_adjoint` does the rest.
        """
        n, size, hyper = self.n_joints, len(x), self.hyper(params)
        rows = read_rows(x.arrays(), self._prismatic())
        memory = _memory(rows, hyper, self.driver.size(n))
        sums = np.zeros(LANES * sum(part.size for part in hyper))
        by_sample = np.ascontiguousarray(weight).reshape(size, n, size, n)
        self.driver.gradient(memory, len(hyper.shares), rows, by_sample, sums)
        parts = np.split(sums.reshape(-1, LANES).sum(1), np.cumsum([part.size for part in hyper])[:-1])
        slopes = Hyper(*(slope.reshape(part.shape) for slope, part in zip(parts, hyper, strict=True)))
        return self.hyper_adjoint(hyper, slopes)

    def cross(self, params: Params, inducing: Motion) -> Cross:
        """Return the covariances of single queries with the inducing samples and with themselves."""
        return CompiledCross(self.driver, self.hyper(params), self._prismatic(), inducing)

    def _gram(self, params: Params, x: Motion, y: Motion, symmetric: bool) -> Array:
        n, hyper, prismatic = self.n_joints, self.hyper(params), self._prismatic()
        rows = read_rows(x.arrays(), prismatic)
        others = rows if symmetric else read_rows(y.arrays(), prismatic)
        out = np.empty((len(x), n, len(y), n))
        self.driver.gram(_memory(others, hyper, self.driver.size(n)), len(hyper.shares), rows, symmetric, out)
        return out.reshape(len(x) * n, len(y) * n)

    def _prismatic(self) -> Flags:
        return np.array([kind == "prismatic" for kind in self.joint_types])


class CompiledCross(Cross):
    """`Cross` of a kernel with a driver. hyper: of `CompiledKernel.hyper`; prismatic: (n,)."""

    def __init__(self, driver: Driver, hyper: Hyper, prismatic: Flags, inducing: Motion) -> None:
        self.size, self.n_joints = len(inducing), inducing.n_joints
        self._run, self._kernels, self._prismatic = driver.cross, len(hyper.shares), prismatic
        work = 6 * self.n_joints + driver.size(self.n_joints)
        self._memory = Memory([columns(read_rows(inducing.arrays(), prismatic), 1), *hyper], work)

    def fill_many(self, motions: Array, out: Array) -> None:
        """Write the covariances of N queries; see `Cross.fill_many`."""
        self._run(self._memory.flat, self._kernels, self._prismatic, motions, out)


def _memory(others: Array, hyper: Hyper, work: int) -> Array:
    return Memory([columns(others, 0), *hyper], work).flat

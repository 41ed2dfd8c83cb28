"""What every torque kernel offers, and the one place where kernel blocks become a Gram matrix."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from lipcore.motion import Motion

Params = Mapping[str, Tensor]
"""Unconstrained hyperparameters by name: logarithms of positive numbers, logits of shares."""

PAIRS_PER_CHUNK = 4096
"""Pairs of samples evaluated together: small enough for the processor's cache, large enough to hide call overhead."""


@dataclass(frozen=True)
class State:
    """One argument of a kernel, joints first so that formulas read as in the paper.

    q, v, a: (n, *batch) position, velocity, acceleration; the batches of two arguments broadcast.
    """

    q: Tensor
    v: Tensor
    a: Tensor

    @classmethod
    def rows(cls, motion: Motion) -> State:
        """First argument of all pairs: (n, N, 1)."""
        return cls(motion.q.T[:, :, None], motion.dq.T[:, :, None], motion.ddq.T[:, :, None])

    @classmethod
    def columns(cls, motion: Motion) -> State:
        """Second argument of all pairs: (n, 1, M)."""
        return cls(motion.q.T[:, None, :], motion.dq.T[:, None, :], motion.ddq.T[:, None, :])

    @classmethod
    def paired(cls, motion: Motion) -> State:
        """Either argument when sample k meets sample k only: (n, N)."""
        return cls(motion.q.T, motion.dq.T, motion.ddq.T)

    def first(self, joints: int) -> State:
        """Only the first `joints` joints: the chain up to a link."""
        return State(self.q[:joints], self.v[:joints], self.a[:joints])


class TorqueKernel(ABC):
    """Prior covariance of the joint torques of an n-joint robot."""

    n_joints: int

    @abstractmethod
    def blocks(self, params: Params, x: State, y: State) -> Tensor:
        """Covariance of torque i at x with torque j at y: (n, n, *batch), (N·m)²."""

    @abstractmethod
    def initial(self, motion: Motion, tau: Tensor) -> dict[str, Tensor]:
        """Hyperparameters to start a fit from, scaled to the data. motion: N samples, tau: (N, n)."""

    def variance(self, params: Params, x: Motion) -> Tensor:
        """Prior covariance of the torques at each sample: (N, n, n)."""
        state = State.paired(x)
        return self.blocks(params, state, state).permute(2, 0, 1)

    def gram(self, params: Params, x: Motion, y: Motion) -> Tensor:
        """Covariance of all torques of x with all of y: (N n, M n), rows and columns sample by sample."""
        n, columns = self.n_joints, State.columns(y)
        out = torch.empty((len(x), n, len(y), n), dtype=torch.float64, device=x.device)
        for rows in row_chunks(len(x), len(y)):
            out[rows] = self.blocks(params, State.rows(x[rows]), columns).permute(2, 0, 3, 1)
        return out.reshape(len(x) * n, len(y) * n)

    def symmetric_gram(self, params: Params, x: Motion) -> Tensor:
        """Covariance of all torques of x with each other, (N n, N n): half the work of `gram`, exactly symmetric."""
        n, size = self.n_joints, len(x)
        out = torch.empty((size, n, size, n), dtype=torch.float64, device=x.device)
        for rows in row_chunks(size, size):
            block = self.blocks(params, State.rows(x[rows]), State.columns(x[rows.start :])).permute(2, 0, 3, 1)
            out[rows, :, rows.start :] = block
            out[rows.start :, :, rows] = block.permute(2, 3, 0, 1)
        gram = out.reshape(size * n, size * n)
        # pairs inside a diagonal block were computed both ways, equal only to rounding
        return 0.5 * (gram + gram.T)


def row_chunks(n_rows: int, n_columns: int) -> Iterator[slice]:
    """Slices over `n_rows` such that rows × `n_columns` stays near PAIRS_PER_CHUNK."""
    step = max(1, PAIRS_PER_CHUNK // max(1, n_columns))
    for start in range(0, n_rows, step):
        yield slice(start, min(start + step, n_rows))


class SumKernel(TorqueKernel):
    """Sum of independent torque priors, e.g. rigid-body dynamics plus friction."""

    def __init__(self, *terms: TorqueKernel) -> None:
        sizes = {term.n_joints for term in terms}
        if len(sizes) != 1:
            raise ValueError(f"terms have {sorted(sizes)} joints, expected the same number in all")
        self.terms = terms
        self.n_joints = terms[0].n_joints

    def blocks(self, params: Params, x: State, y: State) -> Tensor:
        """Sum of the terms' blocks: (n, n, *batch)."""
        total = self.terms[0].blocks(params, x, y)
        for term in self.terms[1:]:
            total = total + term.blocks(params, x, y)
        return total

    def initial(self, motion: Motion, tau: Tensor) -> dict[str, Tensor]:
        """Union of the terms' hyperparameters."""
        return {name: value for term in self.terms for name, value in term.initial(motion, tau).items()}

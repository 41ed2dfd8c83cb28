"""What serving needs of a kernel: features of one query, or its covariances with inducing samples; no PyTorch."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Regressor(ABC):
    """Features Φ of tau = Φ w. Made by `LinearKernel.regressor`; safe from several threads; nothing is checked.

    n_joints: joints n. size: weights p.
    """

    n_joints: int
    size: int

    @abstractmethod
    def fill(self, motion: Array, out: Array) -> None:
        """Write Φᵀ of the query `motion`, (3, n) its q, dq and ddq, into `out`, (p, n), C-contiguous."""


class Cross(ABC):
    """A kernel with its hyperparameters and S inducing samples fixed, ready to meet one query after the other.

    Made by `PairKernel.cross`. Safe from several threads: an implementation keeps memory for each (`threading.local`),
    computes without the GIL and allocates nothing in compiled code. Nothing is checked: arrays are float64 and
    C-contiguous, their shapes as stated.

    n_joints: joints n. size: inducing samples S.
    """

    n_joints: int
    size: int

    @abstractmethod
    def fill(self, motion: Array, out: Array) -> None:
        """Write the covariances of the query's torques into `out`, (S + 1, n, n) (N·m)².

        motion: (3, n), the query's q, dq and ddq; not modified. out[s, i, j] becomes the covariance of torque i at
        inducing sample s with torque j at the query, s < S, and out[S] that of the query's torques with each other,
        symmetric.
        """

    def fill_many(self, motions: Array, out: Array) -> None:
        """`fill` for N queries: motions (N, 3, n), out (N, S + 1, n, n); the same numbers to the last bit."""
        for motion, block in zip(motions, out, strict=True):
            self.fill(motion, block)

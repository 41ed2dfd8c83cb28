"""What serving needs of a torque that is linear in its weights: the features of one query, without PyTorch."""

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

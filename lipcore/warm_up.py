"""Compile every kernel ahead of its first use, for images and installations: `python -m lipcore.warm_up [KERNEL …]`.

Numba keeps the machine code on disk (`NUMBA_CACHE_DIR`, else beside the source, else below the home); without this the
first fit on a machine waits some twenty seconds for it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
import torch

from lipcore.data.motion import Motion
from lipcore.evaluator import Evaluator
from lipcore.kernels.chain import ChainKernel
from lipcore.kernels.friction import FrictionKernel
from lipcore.kernels.gip import GeometricallyInspiredKernel
from lipcore.kernels.lip import LipKernel
from lipcore.kernels.lse import LagrangianSEKernel
from lipcore.kernels.se import SquaredExponentialKernel


def warm_up(*names: str) -> None:
    """Run every compiled function of these kernels once, on a robot of two joints; of all kernels where none is named.

    Raise ValueError for a name that is none.
    """
    if unknown := [name for name in names if name not in _KERNELS]:
        raise ValueError(f"{unknown[0]!r} is no compiled kernel, expected names out of {', '.join(_KERNELS)}")
    ones = torch.ones((2, 2), dtype=torch.float64)
    for name in names or _KERNELS:
        _KERNELS[name](Motion(ones, ones, ones), ones)


def _energy(kernel: LipKernel | ChainKernel, motion: Motion, tau: torch.Tensor) -> None:
    params = kernel.initial(motion, tau)
    kernel.gram(params, motion, motion)
    kernel.gradient(params, motion, kernel.symmetric_gram(params, motion))
    friction = FrictionKernel(2)
    both = {**params, **friction.initial(motion, tau)}
    Evaluator(kernel, both, motion, np.arange(4), [friction], np.ones(10), np.eye(10)).warm_up()


def _baselines(motion: Motion, tau: torch.Tensor) -> None:
    for kernel in (SquaredExponentialKernel(2), GeometricallyInspiredKernel(_TYPES), LagrangianSEKernel(_TYPES)):
        cross = kernel.cross(kernel.initial(motion, tau), motion)
        cross.fill(np.zeros((3, 2)), np.empty((3, 2, 2)))


_TYPES = ("revolute", "revolute")
_KERNELS: dict[str, Callable[[Motion, torch.Tensor], None]] = {
    "lip": lambda motion, tau: _energy(LipKernel(_TYPES), motion, tau),
    "lip-chain": lambda motion, tau: _energy(ChainKernel(_TYPES), motion, tau),
    "baselines": _baselines,
}

if __name__ == "__main__":
    warm_up(*sys.argv[1:])

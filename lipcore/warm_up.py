"""Compile every kernel ahead of its first use, for images and installations: `python -m lipcore.warm_up`.

Numba keeps the machine code on disk (`NUMBA_CACHE_DIR`, else beside the source, else below the home); without this the
first fit on a machine waits some twenty seconds for it.
"""

from __future__ import annotations

import numpy as np
import torch

from lipcore.evaluator import Evaluator
from lipcore.kernels.chain import ChainKernel
from lipcore.kernels.friction import FrictionKernel
from lipcore.kernels.gip import GeometricallyInspiredKernel
from lipcore.kernels.lip import LipKernel
from lipcore.kernels.lse import LagrangianSEKernel
from lipcore.kernels.se import SquaredExponentialKernel
from lipcore.motion import Motion


def warm_up() -> None:
    """Run every compiled function once, on a robot of two joints."""
    ones = torch.ones((2, 2), dtype=torch.float64)
    motion = Motion(ones, ones, ones)
    for kernel in (LipKernel(("revolute", "revolute")), ChainKernel(("revolute", "revolute"))):
        params = kernel.initial(motion, ones)
        kernel.gram(params, motion, motion)
        kernel.gradient(params, motion, kernel.symmetric_gram(params, motion))
        friction = FrictionKernel(2)
        both = {**params, **friction.initial(motion, ones)}
        Evaluator(kernel, both, motion, np.arange(4), [friction], np.ones(10), np.eye(10)).warm_up()
    types = ("revolute", "revolute")
    for baseline in (SquaredExponentialKernel(2), GeometricallyInspiredKernel(types), LagrangianSEKernel(types)):
        cross = baseline.cross(baseline.initial(motion, ones), motion)
        cross.fill(np.zeros((3, 2)), np.empty((3, 2, 2)))


if __name__ == "__main__":
    warm_up()

"""Compile every kernel ahead of its first use, for images and installations: `python -m lipcore.warm_up`.

Numba keeps the machine code on disk (`NUMBA_CACHE_DIR`, else beside the source, else below the home); without this the
first fit on a machine waits some twenty seconds for it.
"""

from __future__ import annotations

import torch

from lipcore.kernels.chain import ChainKernel
from lipcore.kernels.lip import LipKernel
from lipcore.motion import Motion


def warm_up() -> None:
    """Run every compiled function once, on a robot of two joints."""
    ones = torch.ones((2, 2), dtype=torch.float64)
    motion = Motion(ones, ones, ones)
    for kernel in (LipKernel(("revolute", "revolute")), ChainKernel(("revolute", "revolute"))):
        params = kernel.initial(motion, ones)
        kernel.gram(params, motion, motion)
        kernel.gradient(params, motion, kernel.symmetric_gram(params, motion))


if __name__ == "__main__":
    warm_up()

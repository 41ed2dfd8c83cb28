"""Random robots, hyperparameters and motions to test kernels with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch import Tensor

from lipcore.kernels.lip import LipKernel
from lipcore.motion import Motion


@dataclass(frozen=True)
class Problem:
    """A kernel with hyperparameters and a motion to evaluate it on."""

    kernel: LipKernel
    params: dict[str, Tensor]
    motion: Motion


def lip_shapes(n: int, tied: bool) -> dict[str, tuple[int, ...]]:
    """Shapes of the kernel's hyperparameters as its documentation states them."""
    shapes: dict[str, tuple[int, ...]] = {"potential.log_scale": (), "potential.logits": (n, 2)}
    if tied:
        shapes["kinetic.logits"] = (n, 2)
    for link in range(1, n + 1):
        shapes[f"kinetic.{link}.log_weights"] = (link,)
        if not tied:
            shapes[f"kinetic.{link}.logits"] = (link, 2)
    return shapes


def random_problem(joint_types: Sequence[str], samples: int, seed: int, tied: bool = True) -> Problem:
    """Problem of moderate hyperparameters and motion, noise and friction included."""
    rng, n = np.random.default_rng(seed), len(joint_types)
    shapes = lip_shapes(n, tied) | {"noise.log_std": (n,), "friction.log_std": (n, 3)}
    params = {name: torch.from_numpy(rng.uniform(-1.5, 1.0, shape)) for name, shape in shapes.items()}
    params = {name: torch.as_tensor(value, dtype=torch.float64) for name, value in params.items()}
    params["noise.log_std"] = params["noise.log_std"] - 1.0
    motion = Motion.from_arrays(*rng.uniform(-2.0, 2.0, (3, samples, n)))
    return Problem(LipKernel(joint_types, tied), params, motion)


@st.composite
def problems(draw: st.DrawFn, max_joints: int = 4, samples: int = 2) -> Problem:
    """Drawn problems: revolute and prismatic joints mixed, tied and untied, any state within a few rad."""
    joint_types = draw(st.lists(st.sampled_from(["revolute", "prismatic"]), min_size=1, max_size=max_joints))
    tied, n = draw(st.booleans()), len(joint_types)

    def array(shape: tuple[int, ...], bound: float) -> np.ndarray:
        return draw(arrays(np.float64, shape, elements=st.floats(-bound, bound, allow_subnormal=False)))

    params = {name: torch.from_numpy(array(shape, 3.0)) for name, shape in lip_shapes(n, tied).items()}
    motion = Motion.from_arrays(*(array((samples, n), 4.0) for _ in range(3)))
    return Problem(LipKernel(joint_types, tied), params, motion)

"""Random robots, hyperparameters and motions to test kernels with."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch import Tensor

from lipcore.data.motion import Motion
from lipcore.kernels.base import PairKernel, Params, State
from lipcore.kernels.chain import ChainKernel
from lipcore.kernels.lip import LipKernel
from tests.lipcore.oracles import Energy, chain_energies, lip_energies

Shapes = dict[str, tuple[int, ...]]


@dataclass(frozen=True)
class Problem:
    """A kernel with hyperparameters and a motion to evaluate it on."""

    kernel: LipKernel | ChainKernel
    params: dict[str, Tensor]
    motion: Motion

    def energies(self) -> list[Energy]:
        """The energies that the kernel's documentation states: the potential one, then one for each link."""
        energies = lip_energies if isinstance(self.kernel, LipKernel) else chain_energies
        return energies(self.kernel.joint_types, self.params)


class TorchForm(PairKernel):
    """A compiled kernel as devices other than the CPU have it: blocks in PyTorch, gradients by autograd."""

    def __init__(self, kernel: PairKernel) -> None:
        self.kernel, self.n_joints = kernel, kernel.n_joints

    def blocks(self, params: Params, x: State, y: State) -> Tensor:
        """Blocks of the kernel itself."""
        return self.kernel.blocks(params, x, y)

    def initial(self, motion: Motion, tau: Tensor) -> dict[str, Tensor]:
        """Start of the kernel itself."""
        return self.kernel.initial(motion, tau)


def weight_shapes(n: int) -> Shapes:
    """Shapes of the velocity weights' hyperparameters."""
    vectors = {f"kinetic.{name}": (n,) for name in ("log_link", "log_joint", "log_gap")}
    return {"kinetic.log_scale": (), **vectors, "kinetic.log_deviation": (n * (n + 1) // 2,)}


def lip_shapes(n: int, tied: bool) -> Shapes:
    """Shapes of the paper's kernel's hyperparameters as its documentation states them."""
    kinetic = {"kinetic.logits": n} if tied else {f"kinetic.{link}.logits": link for link in range(1, n + 1)}
    shapes: Shapes = {"potential.log_scale": (), "potential.logits": (n, 2)}
    return shapes | {name: (size, 2) for name, size in kinetic.items()} | weight_shapes(n)


def chain_shapes(n: int) -> Shapes:
    """Shapes of the chain kernel's hyperparameters as its documentation states them."""
    return {"chain.logits": (n,), "potential.log_scales": (n,), **weight_shapes(n)}


KERNELS: Mapping[str, tuple[Callable[[Sequence[str]], LipKernel | ChainKernel], Callable[[int], Shapes]]] = {
    "tied": (lambda joint_types: LipKernel(joint_types, tied=True), lambda n: lip_shapes(n, tied=True)),
    "untied": (lambda joint_types: LipKernel(joint_types, tied=False), lambda n: lip_shapes(n, tied=False)),
    "chain": (ChainKernel, chain_shapes),
}
"""Energy kernels by name, each with the shapes of its hyperparameters for n joints."""


def random_problem(joint_types: Sequence[str], samples: int, seed: int, kernel: str = "tied") -> Problem:
    """Problem of moderate hyperparameters and motion, noise and friction included. kernel: of KERNELS."""
    rng, n = np.random.default_rng(seed), len(joint_types)
    make, shapes = KERNELS[kernel]
    both = shapes(n) | {"noise.log_std": (n,), "friction.log_std": (n, 3)}
    params = {name: torch.tensor(rng.uniform(*width(name), shape)).double() for name, shape in both.items()}
    params["noise.log_std"] = params["noise.log_std"] - 1.0
    motion = Motion.from_arrays(*rng.uniform(-2.0, 2.0, (3, samples, n)))
    return Problem(make(joint_types), params, motion)


def width(name: str) -> tuple[float, float]:
    """Range that a hyperparameter is drawn from; five of the velocity weights' add up."""
    return (-0.5, 0.4) if name.startswith("kinetic.log_") else (-1.5, 1.0)


@st.composite
def problems(
    draw: st.DrawFn, max_joints: int = 4, samples: int = 2, kernels: Sequence[str] = tuple(KERNELS)
) -> Problem:
    """Drawn problems: revolute and prismatic joints mixed, any state within a few rad. kernels: of KERNELS."""
    joint_types = draw(st.lists(st.sampled_from(["revolute", "prismatic"]), min_size=1, max_size=max_joints))
    make, shapes = KERNELS[draw(st.sampled_from(kernels))]
    n = len(joint_types)

    def array(shape: tuple[int, ...], bound: float) -> np.ndarray:
        return draw(arrays(np.float64, shape, elements=st.floats(-bound, bound, allow_subnormal=False)))

    bounds = {name: 1.0 if name.startswith("kinetic.log_") else 3.0 for name in shapes(n)}
    params = {name: torch.from_numpy(array(shape, bounds[name])) for name, shape in shapes(n).items()}
    motion = Motion.from_arrays(*(array((samples, n), 4.0) for _ in range(3)))
    return Problem(make(joint_types), params, motion)

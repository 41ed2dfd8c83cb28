"""The compiled LIP kernel and its hand-written gradient against the PyTorch kernel and automatic differentiation."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
import torch
from torch import Tensor

from lipcore.data.motion import Motion
from lipcore.kernels.base import Params, State
from lipcore.kernels.compiled.lip import lip_gradient, lip_gram
from lipcore.kernels.compiled.lip_data import PAIRS
from lipcore.kernels.lip import LipKernel, shares
from lipcore.vocabulary import JointType
from tests.lipcore.problems import random_problem

RELATIVE = 1e-11
REVOLUTE7: tuple[JointType, ...] = ("revolute",) * 7
MIXED: tuple[JointType, ...] = ("prismatic", "revolute", "prismatic", "revolute")
ROBOTS = [REVOLUTE7, MIXED, ("revolute",), ("prismatic",)]
# with one block of pairs, and with a full block and a part of one
SIZES = [3, PAIRS + 5]


class FreeWeights(LipKernel):
    """The kernel with every velocity weight a hyperparameter of its own: a lower triangular matrix."""

    def weights(self, params: Params) -> Tensor:
        return params["weights"]


class Case:
    """One problem as both implementations take it: torch leaves of shares and weights, and arrays."""

    def __init__(self, joint_types: Sequence[JointType], x: Motion, y: Motion, tied: bool, seed: int) -> None:
        n = len(joint_types)
        problem = random_problem(joint_types, 1, seed, "tied" if tied else "untied")
        self.joint_types, self.x, self.y, self.n = joint_types, x, y, n
        params = problem.params
        self.kinetic = torch.full((n, n, 3), 1 / 3, dtype=torch.float64)
        self.weights = torch.from_numpy(np.tril(np.random.default_rng(seed).uniform(0.2, 2.7, (n, n))))
        for link in range(n):
            logits = params["kinetic.logits"] if tied else params[f"kinetic.{link + 1}.logits"]
            if tied:
                self.kinetic[link] = shares(logits)
            else:
                self.kinetic[link, : link + 1] = shares(logits)
        self.potential = shares(params["potential.logits"])
        self.scale = torch.exp(params["potential.log_scale"])

    def arguments(self, symmetric: bool) -> tuple[object, ...]:
        x, y = ([np.ascontiguousarray(part.numpy()) for part in (m.q, m.dq, m.ddq)] for m in (self.x, self.y))
        prismatic = np.array([kind == "prismatic" for kind in self.joint_types])
        tables = (self.kinetic.numpy(), self.weights.numpy(), self.potential.numpy(), float(self.scale))
        return (*x, *y, prismatic, *tables, symmetric)

    def params(self) -> dict[str, torch.Tensor]:
        """An untied kernel's hyperparameters as functions of shares; logits know their ratios only."""
        params = {"potential.log_scale": torch.log(self.scale), "potential.logits": logits(self.potential)}
        for link in range(self.n):
            params[f"kinetic.{link + 1}.logits"] = logits(self.kinetic[link, : link + 1])
        return params | {"weights": self.weights}

    def expected(self) -> torch.Tensor:
        """The Gram matrix from PyTorch, (N, n, M, n).

        The kernel's shares sum to one and its energies are homogeneous in every joint's shares: of degree one the
        potential one, of degree two the kinetic ones. So the sums of the shares move into scale and weights.
        """
        params = self.params()
        params["potential.log_scale"] = params["potential.log_scale"] + torch.log(self.potential.sum(1)).sum()
        totals = [self.kinetic[link, : link + 1].sum(1).prod() for link in range(self.n)]
        params["weights"] = self.weights * torch.stack(totals)[:, None]
        kernel = FreeWeights(self.joint_types, tied=False)
        return kernel.blocks(params, State.rows(self.x), State.columns(self.y)).permute(2, 0, 3, 1)


def logits(values: torch.Tensor) -> torch.Tensor:
    return torch.log(values[:, 1:]) - torch.log(values[:, :1])


def motion(n: int, samples: int, seed: int) -> Motion:
    return Motion.from_arrays(*np.random.default_rng(seed).uniform(-2.0, 2.0, (3, samples, n)))


def relative(actual: np.ndarray | float, expected: torch.Tensor) -> float:
    wanted = expected.detach().numpy()
    return float(np.abs(actual - wanted).max() / max(np.abs(wanted).max(), 1e-300))


def assert_gram_and_gradient_agree(case: Case, symmetric: bool) -> None:
    leaves = (case.kinetic, case.weights, case.potential, case.scale)
    arguments = case.arguments(symmetric)
    for leaf in leaves:
        leaf.requires_grad_()
    expected = case.expected()
    shape = expected.shape
    weight = np.random.default_rng(5).normal(size=shape)
    if symmetric:
        flat = weight.reshape(shape[0] * shape[1], -1)
        weight = (flat + flat.T).reshape(shape)
    wanted = torch.autograd.grad((expected * torch.from_numpy(weight)).sum(), leaves)

    assert relative(lip_gram(*arguments), expected) < RELATIVE
    for got, want in zip(lip_gradient(*arguments, weight), wanted, strict=True):
        assert np.shape(got) == tuple(want.shape)
        assert relative(got, want) < RELATIVE


@pytest.mark.parametrize("samples", SIZES)
@pytest.mark.parametrize("tied", [True, False])
@pytest.mark.parametrize("joint_types", ROBOTS, ids=lambda kinds: f"{len(kinds)}-{kinds[0]}")
def test_symmetric(joint_types: tuple[JointType, ...], tied: bool, samples: int) -> None:
    x = motion(len(joint_types), samples, seed=1)
    assert_gram_and_gradient_agree(Case(joint_types, x, x, tied, seed=3), symmetric=True)


@pytest.mark.parametrize("shape", [(2, 3), (3, PAIRS + 5), (PAIRS + 5, 1)])
@pytest.mark.parametrize("tied", [True, False])
@pytest.mark.parametrize("joint_types", ROBOTS, ids=lambda kinds: f"{len(kinds)}-{kinds[0]}")
def test_rectangular(joint_types: tuple[JointType, ...], tied: bool, shape: tuple[int, int]) -> None:
    n = len(joint_types)
    x, y = motion(n, shape[0], seed=1), motion(n, shape[1], seed=2)
    assert_gram_and_gradient_agree(Case(joint_types, x, y, tied, seed=3), symmetric=False)


def test_rows_of_partly_tied_links_are_not_mixed_up() -> None:
    """Equal shares of neighbouring links let products be reused; the links below and above have their own."""
    x = motion(4, 6, seed=1)
    case = Case(MIXED, x, x, tied=False, seed=3)
    case.kinetic[1, :2] = case.kinetic[2, :2]
    assert_gram_and_gradient_agree(case, symmetric=True)


@pytest.mark.parametrize("zeros", [(0,), (2,), (0, 2), (0, 1, 2)])
def test_base_kernels_of_zero(zeros: tuple[int, ...]) -> None:
    """p_b = 0 of one, two or all joints: the derivatives stay exact, as nothing divides by it."""
    case = Case(("revolute",) * 3, motion(3, 1, seed=1), motion(3, 1, seed=2), tied=False, seed=3)
    for b in zeros:
        # p = σ + α cos π with σ = α is zero to the last bit
        case.x.q[0, b], case.y.q[0, b] = math.pi, 0.0
        case.kinetic[:, b] = case.potential[b] = torch.tensor([0.4, 0.4, 0.2])
    assert_gram_and_gradient_agree(case, symmetric=False)


def test_symmetric_gram_is_symmetric_to_the_last_bit_and_equals_the_full_one() -> None:
    x = motion(7, PAIRS + 5, seed=1)
    case = Case(REVOLUTE7, x, x, tied=True, seed=3)
    half, full = lip_gram(*case.arguments(True)), lip_gram(*case.arguments(False))
    flat = half.reshape(len(x) * 7, -1)
    assert np.array_equal(flat, flat.T)
    assert np.abs(half - full).max() < 1e-13 * np.abs(full).max()


def test_many_joints() -> None:
    joint_types: tuple[JointType, ...] = ("revolute", "prismatic") * 6
    x = motion(12, 2, seed=1)
    assert_gram_and_gradient_agree(Case(joint_types, x, x, tied=False, seed=3), symmetric=True)

"""The compiled serial-chain kernel and its hand-written gradient against the PyTorch formula and autograd."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from lipcore.kernels.base import Params, State
from lipcore.kernels.chain import ChainKernel
from lipcore.kernels.compiled.chain import chain_gradient, chain_gram

RELATIVE = 1e-11
ROBOTS = {
    "7r": ("revolute",) * 7,
    "mixed": ("prismatic", "revolute", "revolute", "prismatic", "revolute"),
    "2r": ("revolute",) * 2,
    "1r": ("revolute",),
    "1p": ("prismatic",),
    "3p": ("prismatic",) * 3,
}


class FreeWeights(ChainKernel):
    """The kernel with every velocity weight a hyperparameter of its own: a lower triangular matrix."""

    def weights(self, params: Params) -> Tensor:
        return params["weights"].tril()


@dataclass
class Case:
    """Samples of both arguments, (3, size, n) each, and the kernel's hyperparameters."""

    joint_types: tuple[str, ...]
    x: np.ndarray
    y: np.ndarray
    params: dict[str, Tensor]
    symmetric: bool

    @classmethod
    def random(cls, joint_types: tuple[str, ...], rows: int, columns: int | None, seed: int = 0) -> Case:
        """Random samples; no columns: both arguments are the same samples."""
        rng = np.random.default_rng(seed)
        n = len(joint_types)
        x = 1.5 * rng.standard_normal((3, rows, n))
        params = {
            "chain.logits": torch.tensor(rng.standard_normal(n)),
            "potential.log_scales": torch.tensor(rng.standard_normal(n)),
            "weights": torch.tensor(np.tril(np.exp(0.5 * rng.standard_normal((n, n))))),
        }
        y = x if columns is None else 1.5 * rng.standard_normal((3, columns, n))
        return cls(joint_types, x, y, params, columns is None)

    def arguments(self) -> tuple:
        """Arguments of the compiled functions."""
        prismatic = np.array([kind == "prismatic" for kind in self.joint_types])
        alpha = torch.sigmoid(self.params["chain.logits"]).numpy()
        scales = torch.exp(self.params["potential.log_scales"]).numpy()
        return (*self.x, *self.y, prismatic, alpha, self.params["weights"].numpy(), scales, self.symmetric)

    def reference(self, params: dict[str, Tensor] | None = None) -> Tensor:
        """The Gram matrix in PyTorch, (N, n, M, n)."""
        x, y = torch.tensor(self.x).transpose(1, 2), torch.tensor(self.y).transpose(1, 2)
        blocks = FreeWeights(self.joint_types).blocks(
            self.params if params is None else params, State(*x.unsqueeze(-1)), State(*y.unsqueeze(-2))
        )
        return blocks.permute(2, 0, 3, 1)

    def weight(self, seed: int = 1) -> np.ndarray:
        """A random matrix, (N, n, M, n), symmetric where the case is."""
        n, rng = len(self.joint_types), np.random.default_rng(seed)
        shape = (self.x.shape[1], n, self.y.shape[1], n)
        weight = rng.standard_normal((shape[0] * n, shape[2] * n))
        return (weight + weight.T if self.symmetric else weight).reshape(shape)


def check_gram(case: Case) -> None:
    expected = case.reference().numpy()
    np.testing.assert_allclose(chain_gram(*case.arguments()), expected, rtol=0, atol=RELATIVE * np.abs(expected).max())


def check_gradient(case: Case) -> None:
    leaves = {name: value.clone().requires_grad_(True) for name, value in case.params.items()}
    weight = case.weight()
    (torch.tensor(weight) * case.reference(leaves)).sum().backward()
    d_alpha, d_weights, d_scales = chain_gradient(*case.arguments(), weight)

    # by the unconstrained hyperparameters of ChainKernel: dα/dlogit = α (1 − α)
    _, alpha, _, scales, _ = case.arguments()[6:]
    actual = {
        "chain.logits": d_alpha * alpha * (1 - alpha),
        "potential.log_scales": d_scales * scales,
        "weights": d_weights,
    }
    for name, leaf in leaves.items():
        expected = leaf.grad.numpy()
        tolerance = RELATIVE * np.abs(expected).max()
        np.testing.assert_allclose(actual[name], expected, rtol=RELATIVE, atol=tolerance, err_msg=name)


@pytest.mark.parametrize("columns", [None, 11, 3, 1], ids=lambda m: "symmetric" if m is None else f"{m} columns")
@pytest.mark.parametrize("robot", ROBOTS)
def test_equals_the_formula_in_pytorch(robot: str, columns: int | None) -> None:
    case = Case.random(ROBOTS[robot], 10, columns)
    check_gram(case)
    check_gradient(case)


@pytest.mark.parametrize("rows", [1, 7, 8, 9, 17])
def test_symmetric_gram_is_exactly_symmetric_for_every_size(rows: int) -> None:
    case = Case.random(ROBOTS["mixed"], rows, None)
    size = rows * len(case.joint_types)
    gram = chain_gram(*case.arguments()).reshape(size, size)
    assert np.array_equal(gram, gram.T)
    check_gram(case)
    check_gradient(case)


@pytest.mark.parametrize("robot", ["7r", "mixed", "3p"])
def test_base_kernels_may_be_zero(robot: str) -> None:
    case = Case.random(ROBOTS[robot], 4, 9)
    n = len(case.joint_types)
    # p = 1/2 + cos(q − q') / 2 is zero half a turn away, p = 1/2 + q q' / 2 at q' = −1 / q
    case.params["chain.logits"] = torch.zeros(n).double()
    opposite = [
        -1 / q if kind == "prismatic" else q + math.pi for kind, q in zip(case.joint_types, case.x[0, 0], strict=True)
    ]
    for joint in range(n):
        case.y[0, joint, joint] = opposite[joint]
    case.y[0, 7] = opposite
    case.y[0, 8, :2] = opposite[:2]
    check_gram(case)
    check_gradient(case)


def test_many_joints() -> None:
    case = Case.random(("revolute", "prismatic", "revolute", "revolute") * 4, 2, 3)
    case.params["chain.logits"] -= 3.0
    check_gram(case)
    check_gradient(case)


def test_no_samples() -> None:
    case = Case.random(ROBOTS["2r"], 3, 0)
    assert chain_gram(*case.arguments()).shape == (3, 2, 0, 2)
    assert all(not np.any(part) for part in chain_gradient(*case.arguments(), case.weight()))

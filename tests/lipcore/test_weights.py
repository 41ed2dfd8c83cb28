"""Pooled velocity weights: the formula, and what pooling does to weights that the data say nothing of."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from lipcore.kernels import weights
from lipcore.kernels.chain import ChainKernel
from lipcore.kernels.lip import LipKernel
from lipcore.kernels.weights import initial_weights, velocity_weights
from tests.lipcore.oracles import pooled_weight
from tests.lipcore.problems import weight_shapes


def drawn(n: int, seed: int) -> dict[str, Tensor]:
    rng = np.random.default_rng(seed)
    return {name: torch.tensor(rng.uniform(-2, 2, shape)) for name, shape in weight_shapes(n).items()}


@given(st.integers(1, 8), st.integers(0, 99))
def test_weights_are_five_logarithms_added_up(n: int, seed: int) -> None:
    params = drawn(n, seed)
    found = velocity_weights(params, n)
    assert found.shape == (n, n)
    assert torch.count_nonzero(found.triu(1)) == 0
    for link in range(n):
        for joint in range(link + 1):
            assert float(found[link, joint]) == pytest.approx(float(pooled_weight(params, link, joint)), rel=1e-13)


def test_each_hyperparameter_moves_the_weights_that_it_stands_for() -> None:
    params, n = drawn(4, seed=0), 4
    before = velocity_weights(params, n)
    expected = {
        ("kinetic.log_scale", ()): [(link, a) for link in range(n) for a in range(link + 1)],
        ("kinetic.log_link", (2,)): [(2, 0), (2, 1), (2, 2)],
        ("kinetic.log_joint", (1,)): [(1, 1), (2, 1), (3, 1)],
        ("kinetic.log_gap", (2,)): [(2, 0), (3, 1)],
        ("kinetic.log_deviation", (4,)): [(2, 1)],
    }
    for (name, index), entries in expected.items():
        moved = {key: value.clone() for key, value in params.items()}
        moved[name][index] += math.log(3.0)
        ratio = velocity_weights(moved, n) / before
        changed = {(link, a) for link in range(n) for a in range(link + 1) if abs(float(ratio[link, a]) - 1) > 1e-12}
        assert changed == set(entries), name
        assert all(abs(float(ratio[entry]) - 3) < 1e-12 for entry in entries), name


def test_both_energy_kernels_use_them() -> None:
    params, types = drawn(3, seed=1), ("revolute",) * 3
    for kernel in (ChainKernel(types), LipKernel(types), LipKernel(types, tied=False)):
        assert torch.equal(kernel.weights(params), velocity_weights(params, 3))
        assert weight_shapes(3).keys() <= set(kernel.names())
        for name in weight_shapes(3):
            assert kernel.prior_std()[name] == weights.PRIOR_STD[name]


def test_gradient_reaches_every_hyperparameter() -> None:
    params = {name: value.requires_grad_() for name, value in drawn(3, seed=2).items()}
    velocity_weights(params, 3).square().sum().backward()
    assert all(torch.count_nonzero(value.grad) == value.numel() for value in params.values())


@pytest.mark.parametrize("n", [1, 3, 7])
def test_start_is_the_inertia_that_the_torques_hint_at(n: int) -> None:
    tau = torch.zeros((50, n), dtype=torch.float64)
    tau[:, 0] = 40.0
    start = initial_weights(tau)
    assert {name: tuple(value.shape) for name, value in start.items()} == weight_shapes(n)
    total = velocity_weights(start, n).sum(0)
    # a torque of 40 N·m: an arm of about a metre with about 4 kg·m², to which every link contributes alike
    assert float(total[0]) == pytest.approx(4.0)
    assert len(set(velocity_weights(start, n)[torch.tril_indices(n, n).unbind()].tolist())) == 1


def test_start_scales_with_the_torque_and_is_finite_without_any() -> None:
    tau = torch.from_numpy(np.random.default_rng(0).normal(size=(20, 3)))
    small, large = (velocity_weights(initial_weights(scale * tau), 3) for scale in (1.0, 100.0))
    torch.testing.assert_close(large, 100 * small)
    assert all(value.isfinite().all() for value in initial_weights(0 * tau).values())


def test_prior_lets_levels_differ_by_much_and_entries_by_little() -> None:
    width = weights.PRIOR_STD
    assert set(width) == weight_shapes(2).keys()
    assert width["kinetic.log_scale"] > width["kinetic.log_link"] > width["kinetic.log_gap"]
    assert width["kinetic.log_gap"] > width["kinetic.log_joint"] > width["kinetic.log_deviation"]

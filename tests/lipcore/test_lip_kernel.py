"""The closed-form LIP blocks against automatic differentiation of the energies they stand for."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given

from lipcore.data.motion import Motion
from lipcore.kernels.lip import LipKernel, shares
from tests.choosing import slow
from tests.lipcore.agreement import RELATIVE, opposite, worst_block_error, worst_energy_error
from tests.lipcore.oracles import base_kernel, shares_of
from tests.lipcore.problems import Problem, lip_shapes, problems, random_problem


@given(problems(kernels=("tied", "untied")))
def test_blocks_equal_automatic_differentiation_for_drawn_robots(problem: Problem) -> None:
    assert worst_block_error(problem) < RELATIVE


@pytest.mark.parametrize("kernel", ["tied", "untied"])
@pytest.mark.parametrize(
    "joint_types",
    [
        ("revolute",) * 7,
        ("prismatic", "revolute", "revolute", "prismatic"),
        ("revolute", "prismatic", "revolute"),
        ("prismatic",) * 2,
        ("revolute",),
        ("prismatic",),
    ],
    ids=lambda kinds: "".join(kind[0] for kind in kinds),
)
def test_blocks_equal_automatic_differentiation(joint_types: tuple[str, ...], kernel: str) -> None:
    assert worst_block_error(random_problem(joint_types, samples=2, seed=len(joint_types), kernel=kernel)) < RELATIVE


@pytest.mark.parametrize("offset", [0.0, 1e-8, *map(slow, (1e-14, 1e-11, 1e-5, 1e-2))])
@pytest.mark.parametrize("zero_joints", [(0,), (2,), (1, 2), (0, 1, 2, 3)], ids=str)
@pytest.mark.parametrize(
    "joint_types", [("revolute",) * 4, ("prismatic", "revolute", "prismatic", "revolute")], ids=["rrrr", "prpr"]
)
def test_blocks_stay_exact_where_base_kernels_pass_through_zero(
    joint_types: tuple[str, ...], zero_joints: tuple[int, ...], offset: float
) -> None:
    n = len(joint_types)
    rng = np.random.default_rng(n)
    params = random_problem(joint_types, samples=1, seed=n).params
    logits = torch.tensor([[0.9, 1.3]]).double().expand(n, 2)  # σ < α, β: p changes sign
    params["potential.logits"] = params["kinetic.logits"] = logits
    share = shares_of(logits)
    assert (share[:, :1] < share[:, 1:]).all()
    q, q2 = rng.uniform(0.3, 1.2, (2, n))
    for joint in zero_joints:
        q2[joint] = opposite(joint_types[joint], share[joint].tolist(), q[joint])
        p = base_kernel(joint_types[joint], share[joint], torch.tensor(q[joint]), torch.tensor(q2[joint]))
        assert abs(float(p)) < 1e-15
        q2[joint] += offset
    v, v2, a, a2 = rng.uniform(-2, 2, (4, n))
    motion = Motion.from_arrays(np.stack([q, q2]), np.stack([v, v2]), np.stack([a, a2]))
    assert worst_block_error(Problem(LipKernel(joint_types), params, motion), [(0, 1)]) < RELATIVE


@given(problems(max_joints=3, kernels=("tied", "untied")))
def test_energies_equal_automatic_differentiation(problem: Problem) -> None:
    assert worst_energy_error(problem) < RELATIVE


def test_shares_sum_to_one_and_equal_their_definition() -> None:
    logits = torch.tensor([[0.0, 0.0], [3.0, -50.0], [700.0, 1.0]]).double()
    assert torch.allclose(shares(logits).sum(1), torch.ones(3).double(), rtol=0, atol=1e-15)
    assert torch.allclose(shares(logits), shares_of(logits), rtol=1e-14, atol=0)


@pytest.mark.parametrize("kernel", ["tied", "untied"])
def test_initial_hyperparameters_have_the_documented_names_and_shapes(kernel: str) -> None:
    problem = random_problem(("revolute", "prismatic", "revolute"), samples=20, seed=0, kernel=kernel)
    initial = problem.kernel.initial(problem.motion, problem.motion.q)
    assert {name: tuple(value.shape) for name, value in initial.items()} == lip_shapes(3, kernel == "tied")


def test_unknown_joint_type_is_named() -> None:
    with pytest.raises(ValueError, match=r"joint_types\[1\] is 'planar'"):
        LipKernel(("revolute", "planar"))

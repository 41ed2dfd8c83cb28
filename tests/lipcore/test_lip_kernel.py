"""The closed-form LIP blocks against automatic differentiation of the energies they stand for."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
import torch
from hypothesis import given
from torch import Tensor

from lipcore.kernels.base import State
from lipcore.kernels.lip import LipKernel, shares
from lipcore.motion import Motion
from tests.lipcore.oracles import base_kernel, energy_torque, instant, lip_energies, scale_of, shares_of, torque_terms
from tests.lipcore.problems import Problem, lip_shapes, problems, random_problem

RELATIVE = 1e-10


def worst_block_error(problem: Problem, pairs: Sequence[tuple[int, int]] = ((0, 0), (0, 1))) -> float:
    """Largest error over pairs of samples, relative to `scale_of` their terms."""
    kernel, params, motion = problem.kernel, problem.params, problem.motion
    blocks = kernel.blocks(params, State.rows(motion), State.columns(motion))
    energies = lip_energies(kernel.joint_types, params)
    worst = 0.0
    for i, j in pairs:
        x, y = instant(motion, i), instant(motion, j)
        terms = torque_terms(energies, x, y)
        error = float((blocks[:, :, i, j] - terms.sum(0)).abs().max())
        worst = max(worst, error / scale_of(energies, x, y, terms))
    return worst


@given(problems())
def test_blocks_equal_automatic_differentiation_for_drawn_robots(problem: Problem) -> None:
    assert worst_block_error(problem) < RELATIVE


@pytest.mark.parametrize("tied", [True, False])
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
def test_blocks_equal_automatic_differentiation(joint_types: tuple[str, ...], tied: bool) -> None:
    assert worst_block_error(random_problem(joint_types, samples=2, seed=len(joint_types), tied=tied)) < RELATIVE


def opposite(kind: str, share: Tensor, q: float) -> float:
    """The position q' at which the base kernel p(q, q') is zero."""
    sigma, alpha, beta = share.tolist()
    if kind == "prismatic":
        return -(sigma + beta) / (alpha * q)
    cosine, sine = alpha * math.cos(q), beta * math.sin(q)
    return math.atan2(sine, cosine) + math.acos(-sigma / math.hypot(cosine, sine))


@pytest.mark.parametrize("offset", [0.0, 1e-14, 1e-11, 1e-8, 1e-5, 1e-2])
@pytest.mark.parametrize("zero_joints", [(0,), (2,), (1, 2), (0, 1, 2, 3)], ids=str)
@pytest.mark.parametrize(
    "joint_types", [("revolute",) * 4, ("prismatic", "revolute", "prismatic", "revolute")], ids=["rrrr", "prpr"]
)
def test_blocks_stay_exact_where_base_kernels_pass_through_zero(
    joint_types: tuple[str, ...], zero_joints: tuple[int, ...], offset: float
) -> None:
    n = len(joint_types)
    rng = np.random.default_rng(n)
    params = {name: torch.as_tensor(rng.uniform(-1, 1, shape)) for name, shape in lip_shapes(n, tied=True).items()}
    logits = torch.tensor([[0.9, 1.3]]).double().expand(n, 2)  # σ < α, β: p changes sign
    params["potential.logits"] = params["kinetic.logits"] = logits
    share = shares_of(logits)
    assert (share[:, :1] < share[:, 1:]).all()
    q, q2 = rng.uniform(0.3, 1.2, (2, n))
    for joint in zero_joints:
        q2[joint] = opposite(joint_types[joint], share[joint], q[joint])
        p = base_kernel(joint_types[joint], share[joint], torch.tensor(q[joint]), torch.tensor(q2[joint]))
        assert abs(float(p)) < 1e-15
        q2[joint] += offset
    v, v2, a, a2 = rng.uniform(-2, 2, (4, n))
    motion = Motion.from_arrays(np.stack([q, q2]), np.stack([v, v2]), np.stack([a, a2]))
    assert worst_block_error(Problem(LipKernel(joint_types), params, motion), [(0, 1)]) < RELATIVE


@given(problems(max_joints=3))
def test_energies_equal_automatic_differentiation(problem: Problem) -> None:
    kernel, params, motion = problem.kernel, problem.params, problem.motion
    answer = kernel.energies(params, State.rows(motion), State.columns(motion))
    energies = lip_energies(kernel.joint_types, params)
    for i, j in ((0, 0), (0, 1)):
        x, y = instant(motion, i), instant(motion, j)
        terms = energy_torque(energies, x, y)
        expected = torch.stack([terms[1:].sum(0), terms[0]])
        error = float((answer[:, :, i, j] - expected).abs().max())
        assert error / scale_of(energies, x, y, terms) < RELATIVE


def test_shares_sum_to_one_and_equal_their_definition() -> None:
    logits = torch.tensor([[0.0, 0.0], [3.0, -50.0], [700.0, 1.0]]).double()
    assert torch.allclose(shares(logits).sum(1), torch.ones(3).double(), rtol=0, atol=1e-15)
    assert torch.allclose(shares(logits), shares_of(logits), rtol=1e-14, atol=0)


@pytest.mark.parametrize("tied", [True, False])
def test_initial_hyperparameters_have_the_documented_names_and_shapes(tied: bool) -> None:
    problem = random_problem(("revolute", "prismatic", "revolute"), samples=20, seed=0, tied=tied)
    initial = problem.kernel.initial(problem.motion, problem.motion.q)
    assert {name: tuple(value.shape) for name, value in initial.items()} == lip_shapes(3, tied)


def test_untied_kernel_with_equal_shapes_in_all_links_is_the_tied_kernel() -> None:
    problem = random_problem(("revolute", "prismatic", "revolute"), samples=4, seed=3)
    untied = dict(problem.params)
    logits = untied.pop("kinetic.logits")
    untied |= {f"kinetic.{link}.logits": logits[:link] for link in (1, 2, 3)}
    tied_gram = problem.kernel.gram(problem.params, problem.motion, problem.motion)
    untied_gram = LipKernel(problem.kernel.joint_types, tied=False).gram(untied, problem.motion, problem.motion)
    assert torch.equal(tied_gram, untied_gram)


def test_unknown_joint_type_is_named() -> None:
    with pytest.raises(ValueError, match=r"joint_types\[1\] is 'planar'"):
        LipKernel(("revolute", "planar"))

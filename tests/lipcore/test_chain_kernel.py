"""The closed-form blocks of a serial chain against automatic differentiation, and what a chain knows of geometry."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given

from lipcore import FitOptions, train
from lipcore.data.metrics import evaluate
from lipcore.data.motion import Motion
from lipcore.kernels.base import State
from lipcore.kernels.chain import ChainKernel
from lipcore.robots.library import Robot, pinocchio
from lipcore.robots.simulation import Stream, simulate
from tests.choosing import slow
from tests.lipcore.agreement import RELATIVE, opposite, worst_block_error, worst_energy_error
from tests.lipcore.oracles import chain_base_kernel
from tests.lipcore.problems import Problem, chain_shapes, problems, random_problem

ROBOTS = [
    ("revolute",) * 7,
    ("prismatic", "revolute", "revolute", "prismatic"),
    ("revolute", "prismatic", "revolute"),
    ("prismatic",) * 2,
    ("revolute",),
    ("prismatic",),
]
robots = pytest.mark.parametrize("joint_types", ROBOTS, ids=lambda kinds: "".join(kind[0] for kind in kinds))


@given(problems(kernels=["chain"]))
def test_blocks_equal_automatic_differentiation_for_drawn_robots(problem: Problem) -> None:
    assert worst_block_error(problem) < RELATIVE


@robots
def test_blocks_equal_automatic_differentiation(joint_types: tuple[str, ...]) -> None:
    assert worst_block_error(random_problem(joint_types, 2, seed=len(joint_types), kernel="chain")) < RELATIVE


@given(problems(max_joints=3, kernels=["chain"]))
def test_energies_equal_automatic_differentiation_for_drawn_robots(problem: Problem) -> None:
    assert worst_energy_error(problem) < RELATIVE


@robots
def test_energies_equal_automatic_differentiation(joint_types: tuple[str, ...]) -> None:
    assert worst_energy_error(random_problem(joint_types, 2, seed=len(joint_types), kernel="chain")) < RELATIVE


@pytest.mark.parametrize("offset", [0.0, 1e-8, *map(slow, (1e-14, 1e-11, 1e-5, 1e-2))])
@pytest.mark.parametrize("zero_joints", [(0,), (2,), (1, 2), (0, 1, 2, 3)], ids=str)
@pytest.mark.parametrize(
    "joint_types", [("revolute",) * 4, ("prismatic", "revolute", "prismatic", "revolute")], ids=["rrrr", "prpr"]
)
def test_blocks_stay_exact_where_base_kernels_pass_through_zero(
    joint_types: tuple[str, ...], zero_joints: tuple[int, ...], offset: float
) -> None:
    rng, n = np.random.default_rng(4), len(joint_types)
    params = random_problem(joint_types, samples=1, seed=n, kernel="chain").params
    params["chain.logits"] = torch.tensor(rng.uniform(0.3, 1.5, n))  # σ < α: p changes sign
    alpha = torch.sigmoid(params["chain.logits"])
    q, q2 = rng.uniform(0.3, 1.2, (2, n))
    for joint in zero_joints:
        kind, share = joint_types[joint], float(alpha[joint])
        q2[joint] = opposite(kind, (1 - share, share, share if kind == "revolute" else 0.0), q[joint])
        p = chain_base_kernel(kind, alpha[joint], torch.tensor(q[joint]), torch.tensor(q2[joint]))
        assert abs(float(p)) < 1e-15
        q2[joint] += offset
    v, v2, a, a2 = rng.uniform(-2, 2, (4, n))
    motion = Motion.from_arrays(np.stack([q, q2]), np.stack([v, v2]), np.stack([a, a2]))
    problem = Problem(ChainKernel(joint_types), params, motion)
    assert worst_block_error(problem, [(0, 1)]) < RELATIVE
    assert worst_energy_error(problem, [(0, 1)]) < RELATIVE


@pytest.mark.parametrize("joint", [0, 2, 3])
def test_zero_of_a_revolute_joint_is_of_no_account(joint: int) -> None:
    problem = random_problem(("revolute", "prismatic", "revolute", "revolute"), 6, seed=1, kernel="chain")
    kernel, params, motion = problem.kernel, problem.params, problem.motion
    offset = torch.zeros(4, dtype=torch.float64)
    offset[joint] = 1.234
    moved = Motion(motion.q + offset, motion.dq, motion.ddq)
    before, after = (kernel.blocks(params, State.rows(m), State.columns(m)) for m in (motion, moved))
    assert (after - before).abs().max() < 1e-12 * before.abs().max()
    before, after = (kernel.gram(params, m, m) for m in (motion, moved))
    assert (after - before).abs().max() < 1e-12 * before.abs().max()


def test_first_joint_moves_no_kinetic_energy_of_a_chain() -> None:
    """The kinetic energy does not depend on the first joint's position; gravity does."""
    problem = random_problem(("revolute",) * 3, 2, seed=2, kernel="chain")
    motion = problem.motion
    turned = Motion(motion.q + torch.tensor([0.7, 0.0, 0.0]).double(), motion.dq, motion.ddq)
    pairs = [(State.paired(motion), State.paired(m)) for m in (motion, turned)]
    before, after = (problem.kernel.energy_covariance(problem.params, *pair) for pair in pairs)
    assert torch.equal(before[0], after[0])
    assert (before[1] - after[1]).abs().min() > 1e-3


def test_initial_hyperparameters_have_the_documented_names_and_shapes_and_suit_the_torques() -> None:
    problem = random_problem(("revolute", "prismatic", "revolute"), samples=40, seed=0, kernel="chain")
    tau = torch.from_numpy(np.random.default_rng(1).normal(size=(40, 3)) * [0.1, 30.0, 4.0])
    initial = problem.kernel.initial(problem.motion, tau)
    assert {name: tuple(value.shape) for name, value in initial.items()} == chain_shapes(3)
    assert problem.kernel.names() == list(initial)
    assert problem.kernel.prior_std().keys() <= initial.keys()
    # at standstill nothing but gravity: a torque that moves as much as the measured one, joint by joint
    rest = Motion(problem.motion.q, 0 * problem.motion.q, 0 * problem.motion.q)
    revolute = [0, 2]
    prior = problem.kernel.variance(initial, rest).diagonal(dim1=1, dim2=2).mean(0)
    ratio = (prior / tau.square().mean(0))[revolute]
    assert ((ratio > 0.1) & (ratio < 10)).all(), ratio


def test_initial_hyperparameters_are_finite_without_any_torque() -> None:
    problem = random_problem(("revolute",) * 2, samples=5, seed=0, kernel="chain")
    initial = problem.kernel.initial(problem.motion, torch.zeros((5, 2), dtype=torch.float64))
    assert all(value.isfinite().all() for value in initial.values())


def test_unknown_joint_type_is_named() -> None:
    with pytest.raises(ValueError, match=r"joint_types\[1\] is 'planar'"):
        ChainKernel(("revolute", "planar"))


def random_arm(kinds: str, seed: int) -> Robot:
    """A serial arm of revolute (r) and prismatic (p) joints: random axes, placements and bodies."""
    pin, rng = pinocchio(), np.random.default_rng(seed)
    model, parent = pin.Model(), 0
    for index, kind in enumerate(kinds):
        axis = rng.standard_normal(3)
        axis /= np.linalg.norm(axis)
        joint = pin.JointModelRevoluteUnaligned(axis) if kind == "r" else pin.JointModelPrismaticUnaligned(axis)
        placement = pin.SE3(pin.exp3(rng.standard_normal(3)), rng.uniform(-0.5, 0.5, 3))
        parent = model.addJoint(parent, joint, placement, f"joint{index}")
        square = rng.standard_normal((3, 3))
        inertia = pin.Inertia(rng.uniform(0.5, 3.0), rng.uniform(-0.3, 0.3, 3), 0.02 * (square @ square.T) + 0.01)
        model.appendBodyToJoint(parent, inertia, pin.SE3.Identity())
    types = tuple("revolute" if kind == "r" else "prismatic" for kind in kinds)
    names = tuple(f"joint{index}" for index in range(len(kinds)))
    n = len(kinds)
    return Robot("random", model, names, types, np.full(n, -1.5), np.full(n, 1.5), np.full(n, np.inf))


@pytest.mark.parametrize("kinds", ["rr", "rpr", *map(slow, ("rrr", "prr"))])
def test_dynamics_of_a_true_chain_lie_in_the_space_of_the_kernel(kinds: str) -> None:
    """Enough noise-free torques of an arm pin down all that it ever does, whatever the hyperparameters."""
    pytest.importorskip("pinocchio")
    arm = random_arm(kinds, seed=len(kinds))
    options = FitOptions(hyperparameter_samples=80, posterior_samples=400, max_iterations=30, device="cpu")
    training = simulate(arm, Stream(400, speed=10, noise=0.0, motion="full"), seed=1)
    model = train(training, arm.joint_types, "lip-chain", options)
    unseen = simulate(arm, Stream(100, n_sinusoids=100, speed=10, noise=0.0, motion="full"), seed=2)
    answer = model.predict(unseen.q, unseen.dq, unseen.ddq)
    nmse = evaluate(unseen.tau, answer.tau, answer.tau_std, answer.noise_std).nmse
    print(f"\n{kinds}: nMSE {nmse}")  # noqa: T201
    assert (nmse < 1e-6).all(), nmse

"""Tests of the energy kernels against automatic differentiation of their energies."""

import numpy as np
import pytest
import torch
from hypothesis import given

from lipcore import FitOptions, train
from lipcore.data.metrics import evaluate
from lipcore.data.motion import Motion
from lipcore.kernels.lip import shares
from lipcore.robots.simulation import Simulation, simulate
from tests.choosing import slow
from tests.lipcore.arm_oracles import arm
from tests.lipcore.oracles import (
    KERNELS,
    RELATIVE_TOLERANCE,
    Problem,
    base_kernel,
    base_shares,
    cross_zeros,
    problems,
    random_problem,
    shares_of,
    worst_block_error,
    worst_energy_error,
)

MIXED = ("revolute", "prismatic", "revolute")
ROBOTS = [("revolute",) * 7, ("prismatic", "revolute", "revolute", "prismatic"), MIXED, ("revolute",), ("prismatic",)]
kernels = pytest.mark.parametrize("kernel", KERNELS)


@pytest.mark.slow
@given(problems())
def test_blocks_equal_automatic_differentiation_for_random_robots(problem: Problem) -> None:
    assert worst_block_error(problem) < RELATIVE_TOLERANCE


@pytest.mark.slow
@given(problems(max_joints=3))
def test_energies_equal_automatic_differentiation_for_random_robots(problem: Problem) -> None:
    assert worst_energy_error(problem) < RELATIVE_TOLERANCE


@kernels
@pytest.mark.parametrize("joint_types", ROBOTS, ids=lambda kinds: "".join(kind[0] for kind in kinds))
def test_blocks_equal_automatic_differentiation(joint_types: tuple[str, ...], kernel: str) -> None:
    assert worst_block_error(random_problem(joint_types, 2, seed=len(joint_types), kernel=kernel)) < RELATIVE_TOLERANCE


@pytest.mark.parametrize("kernel", ["tied", "chain"])
@pytest.mark.parametrize("offset", [0.0, 1e-8, *map(slow, (1e-14, 1e-11, 1e-5, 1e-2))])
@pytest.mark.parametrize("zero_joints", [(0,), (2,), (1, 2), (0, 1, 2, 3)], ids=str)
@pytest.mark.parametrize(
    "joint_types", [("revolute",) * 4, ("prismatic", "revolute", "prismatic", "revolute")], ids=["rrrr", "prpr"]
)
def test_kernels_stay_exact_at_zeros_of_base_kernels(
    joint_types: tuple[str, ...], zero_joints: tuple[int, ...], offset: float, kernel: str
) -> None:
    rng, n = np.random.default_rng(4), len(joint_types)
    problem = random_problem(joint_types, 2, seed=n, kernel=kernel)
    if kernel == "chain":  # σ < α: p changes sign
        problem.params["chain.logits"] = np.array(rng.uniform(0.3, 1.5, n))
    else:
        problem.params["potential.logits"] = problem.params["kinetic.logits"] = np.tile([0.9, 1.3], (n, 1))
    problem = cross_zeros(problem, rng.uniform(0.3, 1.2, n), zero_joints)
    for joint in zero_joints:
        share, (at, there) = base_shares(problem)[joint], torch.from_numpy(problem.motion.q[:, joint])
        p = base_kernel(joint_types[joint], torch.from_numpy(share), at, there)
        assert abs(float(p)) < 1e-15
    crossing = cross_zeros(problem, problem.motion.q[0], zero_joints, offset)
    assert worst_block_error(crossing, [(0, 1)]) < RELATIVE_TOLERANCE
    if kernel == "chain":  # for the other kernel these energies are zero, which leaves no relative error
        assert worst_energy_error(crossing, [(0, 1)]) < RELATIVE_TOLERANCE


@pytest.mark.parametrize("joint", [0, 2, 3])
def test_chain_does_not_depend_on_revolute_zero(joint: int) -> None:
    problem = random_problem((*MIXED, "revolute"), 6, seed=1, kernel="chain")
    kernel, params, motion = problem.kernel, problem.params, problem.motion
    offset = np.zeros(4)
    offset[joint] = 1.234
    moved = Motion(motion.q + offset, motion.dq, motion.ddq)
    before, after = (kernel.gram(params, m, m) for m in (motion, moved))
    assert np.abs(after - before).max() < 1e-12 * np.abs(before).max()


def test_shares_sum_to_one_and_match_their_definition() -> None:
    logits = np.array([[0.0, 0.0], [3.0, -50.0], [700.0, 1.0]])
    assert np.allclose(shares(logits).sum(1), np.ones(3), rtol=0, atol=1e-15)
    assert np.allclose(shares(logits), shares_of(torch.from_numpy(logits)), rtol=1e-14, atol=0)


@pytest.mark.parametrize("kinds", ["RPR", *map(slow, ("RR", "RRR", "PRR"))])
def test_chain_kernel_contains_the_dynamics_of_chains(kinds: str) -> None:
    """Enough noise-free torques determine all motion of an arm, whatever the hyperparameters."""
    _, _, robot = arm(kinds, seed=len(kinds))
    options = FitOptions(hyperparameter_samples=80, posterior_samples=400, max_iterations=30, device="cpu")
    training = simulate(robot, Simulation(400, speed=10, noise=0.0, motion="full"), seed=1)
    model = train(training, robot.joint_types, "lip-chain", options)
    unseen = simulate(robot, Simulation(100, n_sinusoids=100, speed=10, noise=0.0, motion="full"), seed=2)
    answer = model.predict(unseen.q, unseen.dq, unseen.ddq)
    nmse = evaluate(unseen.tau, *answer.interval).nmse
    assert (nmse < 1e-6).all(), nmse

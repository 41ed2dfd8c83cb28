"""A model trained without friction or noise obeys the laws its prior is made of, where it has never been."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin
import pytest
import torch

from lipcore import FitOptions, Samples, TorqueModel, train
from lipcore.data.metrics import evaluate
from lipcore.data.motion import Motion
from lipcore.model import dynamics
from lipcore.robots.library import Robot, load_robot
from lipcore.robots.simulation import Stream, simulate


class Case(NamedTuple):
    """What is trained, and how close it has to come on a trajectory it has not seen.

    nmse: largest of any joint; inertia: largest error of an entry, relative to the largest entry at that posture;
    gravity: largest error, relative to the largest gravity torque.
    """

    robot: str
    train: Stream
    seed: int
    options: FitOptions
    nmse: float
    inertia: float
    gravity: float


# bounds are three to five times what was measured
CASES = {
    "ur5": Case(
        "ur5",
        Stream(n_samples=200, motion="middle", speed=10, noise=0.0),
        5,
        FitOptions(hyperparameter_samples=100, max_iterations=100, starts=1, device="cpu"),
        nmse=0.001,
        inertia=0.02,
        gravity=0.0001,
    ),
    "panda": Case(
        "panda",
        Stream(n_samples=500, motion="middle", speed=10, noise=0.0),
        5,
        FitOptions(hyperparameter_samples=100, max_iterations=100, starts=1, device="cpu"),
        nmse=0.004,
        inertia=0.025,
        gravity=0.001,
    ),
}


class Trained(NamedTuple):
    """A trained case, an unseen trajectory, and the learnt inertia along it."""

    case: Case
    robot: Robot
    model: TorqueModel
    unseen: Samples
    inertia: np.ndarray


@pytest.fixture(scope="module", params=["ur5", pytest.param("panda", marks=pytest.mark.slow)])
def trained(request: pytest.FixtureRequest) -> Trained:
    case = CASES[request.param]
    robot = load_robot(case.robot)
    model = train(simulate(robot, case.train, case.seed), robot.joint_types, "lip-chain", case.options)
    unseen = simulate(robot, Stream(n_samples=501, n_sinusoids=100, motion="middle", speed=10, noise=0.0), seed=101)
    inertia = dynamics.inertia_matrix(model.posterior, model.estimator.terms["energy"], unseen.motion().q).numpy()
    return Trained(case, robot, model, unseen, inertia)


def learnt_torque(trained: Trained, motion: Motion) -> torch.Tensor:
    """Torque of the learnt energies, friction left out."""
    return trained.model.posterior.mean(motion, trained.model.estimator.terms["energy"])


def test_torque_on_an_unseen_trajectory(trained: Trained) -> None:
    unseen = trained.unseen
    answer = trained.model.predict(unseen.q, unseen.dq, unseen.ddq)
    metrics = evaluate(unseen.tau, answer.tau, answer.tau_std, answer.noise_std)
    print(f"\n{trained.case.robot}: nMSE {metrics.nmse.round(6)}, coverage {metrics.coverage.round(3)}")  # noqa: T201
    assert (metrics.nmse < trained.case.nmse).all()
    assert (metrics.coverage > 0.9).all()  # of 95 %: 0.954 and more was measured


def test_torque_is_affine_in_acceleration(trained: Trained) -> None:
    motion = trained.unseen.motion()[::25]
    other = motion.ddq.flip(0)
    mean = trained.model.posterior.mean
    at_zero, at_one = mean(motion), mean(Motion(motion.q, motion.dq, other))
    for share in (-3.0, 0.4, 2.0):
        between = mean(Motion(motion.q, motion.dq, (1 - share) * motion.ddq + share * other))
        expected = (1 - share) * at_zero + share * at_one
        assert (between - expected).abs().max() < 1e-7 * expected.abs().max()


def test_torque_is_inertia_times_acceleration_plus_what_velocity_and_gravity_ask(trained: Trained) -> None:
    rows = slice(0, 501, 25)
    motion = trained.unseen.motion()[rows]
    zero = torch.zeros_like(motion.q)
    inertial = torch.einsum("kij,kj->ki", torch.from_numpy(trained.inertia[rows]), motion.ddq)
    at_rest = learnt_torque(trained, Motion(motion.q, zero, zero))
    velocity = [learnt_torque(trained, Motion(motion.q, s * motion.dq, zero)) - at_rest for s in (1.0, -2.0)]
    size = learnt_torque(trained, motion).abs().max()
    assert (velocity[1] - 4 * velocity[0]).abs().max() < 1e-6 * size
    assert (inertial + velocity[0] + at_rest - learnt_torque(trained, motion)).abs().max() < 1e-6 * size


def test_inertia_is_symmetric_and_positive_definite_everywhere(trained: Trained) -> None:
    inertia = trained.inertia
    assert np.abs(inertia - inertia.transpose(0, 2, 1)).max() < 1e-6 * np.abs(inertia).max()
    smallest = np.linalg.eigvalsh(0.5 * (inertia + inertia.transpose(0, 2, 1)))[:, 0]
    count = int((smallest > 0).sum())
    print(f"\n{trained.case.robot}: positive definite at {count} of {len(inertia)}")  # noqa: T201
    assert count == len(inertia) == 501


def test_inertia_is_that_of_pinocchio(trained: Trained) -> None:
    model, data = trained.robot.model, trained.robot.model.createData()
    worst = 0.0
    for k in range(0, 501, 10):
        upper = np.triu(pin.crba(model, data, trained.robot.configuration(trained.unseen.q[k])))
        expected = upper + np.triu(upper, 1).T
        worst = max(worst, float(np.abs(trained.inertia[k] - expected).max() / np.abs(expected).max()))
    print(f"\n{trained.case.robot}: inertia off by {worst:.2e}")  # noqa: T201
    assert worst < trained.case.inertia


def test_gravity_is_that_of_pinocchio(trained: Trained) -> None:
    q = trained.unseen.q[::10]
    learnt = dynamics.gravity(
        trained.model.posterior, trained.model.estimator.terms["energy"], torch.from_numpy(q)
    ).numpy()
    model, data = trained.robot.model, trained.robot.model.createData()
    expected = [pin.computeGeneralizedGravity(model, data, trained.robot.configuration(x)) for x in q]
    worst = float(np.abs(learnt - expected).max() / np.abs(expected).max())
    print(f"\n{trained.case.robot}: gravity off by {worst:.2e}")  # noqa: T201
    assert worst < trained.case.gravity


def test_rate_of_energy_is_power(trained: Trained) -> None:
    """d/dt (T + V) = dq · tau, by a central difference of fourth order along the motion, with no friction in tau."""
    motion, step = trained.unseen.motion()[::10], 1e-3

    def energy(t: float) -> torch.Tensor:
        moved = Motion(motion.q + t * motion.dq + 0.5 * t**2 * motion.ddq, motion.dq + t * motion.ddq, motion.ddq)
        both = dynamics.energies(trained.model.posterior, trained.model.estimator.terms["energy"], moved)
        return both.kinetic + both.potential

    rate = (8 * (energy(step) - energy(-step)) - (energy(2 * step) - energy(-2 * step))) / (12 * step)
    power = (motion.dq * learnt_torque(trained, motion)).sum(1)
    assert power.abs().max() > 0.1
    assert (rate - power).abs().max() < 1e-6 * power.abs().max()


def test_kinetic_energy_is_half_dq_inertia_dq(trained: Trained) -> None:
    rows = slice(0, 501, 25)
    motion = trained.unseen.motion()[rows]
    kinetic = dynamics.energies(trained.model.posterior, trained.model.estimator.terms["energy"], motion).kinetic
    expected = 0.5 * torch.einsum("ki,kij,kj->k", motion.dq, torch.from_numpy(trained.inertia[rows]), motion.dq)
    assert (kinetic - expected).abs().max() < 1e-7 * expected.abs().max()

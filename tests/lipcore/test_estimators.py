"""Every estimator that can be chosen: it fits and predicts, survives awkward data, and its gradient is right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from lipcore import FitOptions, Samples, TorqueModel, train
from lipcore.data.metrics import evaluate
from lipcore.fitting.estimators import ESTIMATORS, UnknownEstimatorError, make_estimator
from lipcore.kernels.arm_prior import Arm, arm_of_robot
from lipcore.posterior.exact import negative_log_evidence
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Stream, simulate
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import AUTO, CHOICES, DEFAULT_ESTIMATOR, ROBOT_ESTIMATORS

ROBOT = "double-pendulum"
TYPES = ("revolute", "revolute")
OPTIONS = FitOptions(hyperparameter_samples=40, max_iterations=40, starts=1, device="cpu")
every_estimator = pytest.mark.parametrize("name", ESTIMATORS)


def recorded(noise: float = 0.002, seed: int = 1) -> Samples:
    return simulate(load_robot(ROBOT), Stream(n_samples=60, speed=10, noise=noise, viscous=0.05), seed)


def robot_of(name: str, samples: Samples) -> RigidBody | None:
    return RigidBody.from_profile(ROBOT, samples.joint_names, TYPES) if name in ROBOT_ESTIMATORS else None


def arm_of(name: str, samples: Samples, prior: str = "urdf", mode: str = "fixed") -> Arm | None:
    robot = robot_of(name, samples)
    return None if robot is None else arm_of_robot(robot, prior=prior, mode=mode)


def trained(name: str, samples: Samples, options: FitOptions = OPTIONS) -> TorqueModel:
    return train(samples, TYPES, name, options, robot=robot_of(name, samples))


@every_estimator
def test_it_learns_a_small_robot(name: str) -> None:
    samples = recorded()
    even = np.arange(60) % 2 == 0
    model = trained(name, samples.rows(even))
    unseen = samples.rows(~even)
    answer = model.predict(unseen.q, unseen.dq, unseen.ddq)
    figures = evaluate(unseen.tau, answer.tau, answer.tau_std, answer.noise_std)
    print(f"\n{name}: nMSE {figures.nmse}, coverage {figures.coverage}")  # noqa: T201
    assert (figures.nmse < (0.1 if name in ("se", "gip", "lse") else 0.01)).all(), figures.nmse
    assert (figures.coverage > 0.7).all(), figures.coverage
    assert model.estimator.name == name
    assert list(model.estimator.terms)[-1] == "friction"
    assert ("rigid_body" in model.estimator.terms) == (name in ROBOT_ESTIMATORS)


def stand_still(samples: Samples) -> Samples:
    """The second joint never moves."""
    q, dq, ddq = samples.q.copy(), samples.dq.copy(), samples.ddq.copy()
    q[:, 1], dq[:, 1], ddq[:, 1] = 0.3, 0.0, 0.0
    return replace(samples, q=q, dq=dq, ddq=ddq)


def stand_at_zero(samples: Samples) -> Samples:
    """No joint ever moves, and all encoders read zero."""
    return replace(samples, q=0 * samples.q, dq=0 * samples.dq, ddq=0 * samples.ddq)


AWKWARD: dict[str, Callable[[], Samples]] = {
    "one joint stands still": lambda: stand_still(recorded()),
    "all joints stand still": lambda: stand_at_zero(recorded()),
    "samples repeat": lambda: recorded().rows(np.arange(60) % 12),
    "free of noise": lambda: recorded(noise=0.0),
    "a joint without torque": lambda: replace(recorded(), tau=recorded().tau * [1.0, 0.0]),
    "no torque at all": lambda: replace(recorded(), tau=0 * recorded().tau),
    "torques in another unit": lambda: replace(recorded(), tau=1e6 * recorded().tau),
}


@pytest.mark.each_once
@pytest.mark.parametrize("data", AWKWARD)
@every_estimator
def test_awkward_data_end_in_a_model(name: str, data: str) -> None:
    samples = AWKWARD[data]()
    model = trained(name, samples, replace(OPTIONS, hyperparameter_samples=25, max_iterations=15))
    answer = model.predict(samples.q, samples.dq, samples.ddq, covariance=True)
    for part in (answer.tau, answer.tau_std, answer.covariance, answer.noise_std):
        assert np.isfinite(part).all()
    assert (answer.noise_std > 0).all()
    if not (data == "no torque at all" and name in ROBOT_ESTIMATORS):  # torques that the URDF's masses rule out
        assert model.fit["jitter"] == 0.0
    elsewhere = model.predict(samples.q + 1.0, 2 * samples.dq, samples.ddq - 1.0)
    assert np.isfinite(elsewhere.tau).all()
    if name != "rigid-body":  # it cannot follow torques that no rigid body asks for
        assert (np.abs(answer.tau - samples.tau).mean(0) <= samples.tau.std(0) + 3 * answer.noise_std).all()


@pytest.mark.parametrize(
    ("name", "prior", "mode"),
    [
        *((name, "urdf", "fixed") for name in ESTIMATORS),
        *((name, "zero", "fixed") for name in ROBOT_ESTIMATORS),
        *((name, "urdf", "calibrate") for name in ROBOT_ESTIMATORS),
    ],
)
def test_gradient_of_the_evidence_equals_finite_differences(name: str, prior: str, mode: str) -> None:
    samples = recorded().rows(np.arange(7))
    kernel = make_estimator(name, TYPES, arm=arm_of(name, samples, prior, mode)).kernel
    motion, tau, rng = samples.motion(), samples.torque(), np.random.default_rng(3)
    params = kernel.initial(motion, tau)
    params = {key: value + 0.3 * torch.tensor(rng.standard_normal(value.shape)) for key, value in params.items()}
    params["noise.log_std"] = torch.full((2,), -2.0, dtype=torch.float64)
    gradient = negative_log_evidence(kernel, params, motion, tau).gradient
    assert gradient.keys() == params.keys()

    def value(key: str, index: tuple[int, ...], step: float) -> float:
        moved = {other: tensor.clone() for other, tensor in params.items()}
        moved[key][index] += step
        return negative_log_evidence(kernel, moved, motion, tau).value

    for key, tensor in params.items():
        assert gradient[key].shape == tensor.shape
        for index in np.ndindex(*tensor.shape):
            near, far = (value(key, index, s * 1e-3) - value(key, index, -s * 1e-3) for s in (1, 2))
            expected = (8 * near - far) / 12e-3
            assert float(gradient[key][index]) == pytest.approx(expected, rel=1e-6, abs=1e-7), (key, index)


def test_every_kernel_names_its_hyperparameters() -> None:
    samples = recorded()
    for name in ESTIMATORS:
        kernel = make_estimator(name, TYPES, arm=arm_of(name, samples)).kernel
        start = kernel.initial(samples.motion(), samples.torque())
        assert kernel.names() == list(start), name
        assert kernel.prior_std().keys() <= start.keys(), name
        assert all(value.dtype == torch.float64 and value.isfinite().all() for value in start.values()), name


def test_default_is_an_estimator_that_needs_no_robot() -> None:
    assert (AUTO, *ESTIMATORS) == CHOICES
    assert DEFAULT_ESTIMATOR in CHOICES
    assert set(ROBOT_ESTIMATORS) <= set(ESTIMATORS)


def test_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(UnknownEstimatorError) as caught:
        make_estimator("newton", TYPES)
    assert str(caught.value) == f"estimator is 'newton', expected one of {', '.join(ESTIMATORS)}"


@pytest.mark.parametrize("joint_types", [(), ("revolute", "planar")])
@every_estimator
def test_unknown_joint_types_are_refused(name: str, joint_types: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="joint_types"):
        make_estimator(name, joint_types)

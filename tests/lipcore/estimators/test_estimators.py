"""Tests of every estimator: fit, prediction, awkward data, gradients and calibration."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike

from lipcore import FitOptions, Samples, TorqueModel, load, save, train
from lipcore.data.metrics import evaluate
from lipcore.data.motion import Motion
from lipcore.estimators.catalogue import (
    ESTIMATORS,
    FUNCTION_STD_FACTOR,
    NO_CALIBRATION,
    Calibration,
    calibrate,
    make_estimator,
)
from lipcore.kernels.arm_prior import arm_of_robot
from lipcore.kernels.arrays import on_last_diagonal
from lipcore.model import dynamics
from lipcore.model.parameters import friction_coefficients, inertial_parameters, weight_posterior
from lipcore.posterior.exact import negative_log_evidence
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from lipcore.robots.urdf import RigidBody
from lipcore.training import fit
from lipcore.vocabulary import ROBOT_ESTIMATORS
from tests.lipcore.arm_oracles import assert_predicts_finite_torque, hold_joints

ROBOT = "double-pendulum"
TYPES = ("revolute", "revolute")
OPTIONS = FitOptions(hyperparameter_samples=40, max_iterations=40, starts=1, device="cpu")
FIT_TOLERANCE = 1e-6
"""Largest relative difference between two fits to the same samples: the steps of a search amplify rounding."""
every_estimator = pytest.mark.parametrize("name", ESTIMATORS)


def simulate_pendulum(noise: float = 0.002) -> Samples:
    return simulate(load_robot(ROBOT), Simulation(n_samples=60, speed=10, noise=noise, viscous=0.05), seed=1)


def robot_of(name: str, samples: Samples) -> RigidBody | None:
    return RigidBody.from_profile(ROBOT, samples.joint_names, TYPES) if name in ROBOT_ESTIMATORS else None


def train_estimator(name: str, samples: Samples, options: FitOptions = OPTIONS) -> TorqueModel:
    return train(samples, TYPES, name, options, robot=robot_of(name, samples))


def assert_close(found: ArrayLike, expected: ArrayLike, share: float = FIT_TOLERANCE) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=share * np.abs(np.asarray(expected)).max())


@every_estimator
def test_estimator_learns_a_small_robot_and_is_loaded_unchanged(name: str, tmp_path: Path) -> None:
    samples = simulate_pendulum()
    even = np.arange(60) % 2 == 0
    model = train_estimator(name, samples.rows(even))
    unseen = samples.rows(~even)
    answer = model.predict(unseen.q, unseen.dq, unseen.ddq, covariance=True)
    figures = evaluate(unseen.tau, *answer.interval)
    assert (figures.nmse < (0.1 if name in ("se", "gip", "lse") else 0.01)).all(), figures.nmse
    assert (figures.coverage > 0.7).all(), figures.coverage
    assert model.estimator.name == name
    assert list(model.estimator.terms)[-1] == "friction"
    assert ("rigid_body" in model.estimator.terms) == (name in ROBOT_ESTIMATORS)
    save(model, tmp_path / "model")
    again = load(tmp_path / "model").predict(unseen.q, unseen.dq, unseen.ddq, covariance=True)
    for part in ("tau", "tau_std", "noise_std", "covariance"):
        assert_close(getattr(again, part), getattr(answer, part), 1e-9)


AWKWARD_DATA: dict[str, Callable[[], Samples]] = {
    "one joint stands still": lambda: hold_joints(simulate_pendulum(), [1], 0.3),
    "all joints stand still": lambda: hold_joints(simulate_pendulum(), [0, 1], 0.0),
    "samples repeat": lambda: simulate_pendulum().rows(np.arange(60) % 12),
    "free of noise": lambda: simulate_pendulum(noise=0.0),
    "a joint without torque": lambda: replace(simulate_pendulum(), tau=simulate_pendulum().tau * [1.0, 0.0]),
    "no torque at all": lambda: replace(simulate_pendulum(), tau=0 * simulate_pendulum().tau),
    "torques in another unit": lambda: replace(simulate_pendulum(), tau=1e6 * simulate_pendulum().tau),
}


@pytest.mark.each_once
@pytest.mark.parametrize("data", AWKWARD_DATA)
@every_estimator
def test_awkward_data_give_a_model(name: str, data: str) -> None:
    samples = AWKWARD_DATA[data]()
    model = train_estimator(name, samples, replace(OPTIONS, hyperparameter_samples=25, max_iterations=15))
    answer = assert_predicts_finite_torque(model, samples)
    if not (data == "no torque at all" and name in ROBOT_ESTIMATORS):  # the URDF's masses rule out zero torque
        assert model.fit["jitter"] == 0.0

    if name != "rigid-body":  # rigid bodies cannot produce all of these torques
        assert (np.abs(answer.tau - samples.tau).mean(0) <= samples.tau.std(0) + 3 * answer.noise_std).all()


@pytest.mark.parametrize(
    ("name", "prior", "mode"),
    [
        *((name, "urdf", "fixed") for name in ESTIMATORS),
        *((name, "zero", "fixed") for name in ROBOT_ESTIMATORS),
        *((name, "urdf", "calibrate") for name in ROBOT_ESTIMATORS),
    ],
)
def test_evidence_gradient_matches_finite_differences(name: str, prior: str, mode: str) -> None:
    samples = simulate_pendulum().rows(np.arange(7))
    robot = robot_of(name, samples)
    arm = None if robot is None else arm_of_robot(robot, prior=prior, mode=mode)
    kernel = make_estimator(name, TYPES, arm=arm).kernel
    motion, tau, rng = samples.motion(), samples.tau, np.random.default_rng(3)
    params = kernel.initial(motion, tau)
    params = {key: value + 0.3 * np.array(rng.standard_normal(value.shape)) for key, value in params.items()}
    params["noise.log_std"] = np.full((2,), -2.0)
    gradient = negative_log_evidence(kernel, params, motion, tau).gradient
    assert gradient.keys() == params.keys()

    def value(key: str, index: tuple[int, ...], step: float) -> float:
        moved = {other: np.array(tensor) for other, tensor in params.items()}
        moved[key][index] += step
        return negative_log_evidence(kernel, moved, motion, tau).value

    for key, tensor in params.items():
        assert gradient[key].shape == tensor.shape
        for index in np.ndindex(*tensor.shape):
            near, far = (value(key, index, s * 1e-3) - value(key, index, -s * 1e-3) for s in (1, 2))
            expected = (8 * near - far) / 12e-3
            assert float(gradient[key][index]) == pytest.approx(expected, rel=1e-6, abs=1e-7), (key, index)


SMALL_OPTIONS = FitOptions(
    hyperparameter_samples=20, posterior_samples=50, max_iterations=10, starts=1, device="cpu", statistics="chosen"
)


@pytest.fixture(scope="module")
def samples() -> Samples:
    return simulate_pendulum(noise=1e-4)


@pytest.fixture(scope="module")
def model(samples: Samples) -> TorqueModel:
    return train(samples, TYPES, "lip-chain", SMALL_OPTIONS)


def test_batch_prediction_equals_single_predictions(model: TorqueModel, samples: Samples) -> None:
    many = model.predict(samples.q, samples.dq, samples.ddq, covariance=True)
    assert many.tau.shape == many.tau_std.shape == (60, 2)
    assert many.covariance.shape == (60, 2, 2)
    assert many.noise_std.shape == (2,)
    for k in (0, 31, 59):
        one = model.predict(samples.q[k], samples.dq[k], samples.ddq[k], covariance=True)
        assert np.allclose(one.tau[0], many.tau[k], rtol=1e-8, atol=1e-10)
        assert np.allclose(one.covariance[0], many.covariance[k], rtol=1e-6, atol=1e-12)
    assert np.allclose(many.tau_std**2, np.diagonal(many.covariance, axis1=1, axis2=2), rtol=1e-12)
    with pytest.raises(ValueError, match="q has 3 joints, expected 2: joint1, joint2"):
        model.predict(*np.zeros((3, 4, 3)))
    with pytest.raises(ValueError, match=r"ddq has shape \(3, 2\), expected \(4, 2\)"):
        model.predict(np.zeros((4, 2)), np.zeros((4, 2)), np.zeros((3, 2)))


def test_invalid_training_argument_is_named(samples: Samples) -> None:
    good = {"joint_types": TYPES, "estimator": "lip-chain", "options": SMALL_OPTIONS}
    for arguments, message in (
        ({"joint_types": ("revolute",)}, "joint_types has 1 entries, expected 2"),
        ({"joint_types": ("revolute", "spherical")}, r"joint_types\[1\] is 'spherical'"),
        ({"torque_convention": "none"}, "torque_convention is 'none', expected one of gravity_included"),
        ({"estimator": "oracle"}, "estimator is 'oracle', expected one of auto, lip"),
    ):
        with pytest.raises(ValueError, match=message):
            train(samples, **(good | arguments))
    for name in ("q", "dq", "ddq", "tau"):
        values = getattr(samples, name).copy()
        values[3, 1] = np.nan
        with pytest.raises(ValueError, match=rf"{name}\[3, 1\]"):
            train(replace(samples, **{name: values}), TYPES, "lip-chain", SMALL_OPTIONS)


FACTOR = 1.75

ZERO_PRIOR_OPTIONS = FitOptions(hyperparameter_samples=30, max_iterations=20, starts=1, device="cpu", prior="zero")


@pytest.fixture(scope="module", params=["lip-chain", "lip", "rigid-body"])
def calibration_pair(request: pytest.FixtureRequest, samples: Samples) -> tuple[TorqueModel, TorqueModel]:
    """Return the same model without and with a calibration factor."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit, "calibrate", lambda name: NO_CALIBRATION)
        plain = train_estimator(request.param, samples, ZERO_PRIOR_OPTIONS)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(FUNCTION_STD_FACTOR, request.param, FACTOR)
        return plain, train_estimator(request.param, samples, ZERO_PRIOR_OPTIONS)


def test_calibration_scales_predictions(calibration_pair: tuple[TorqueModel, TorqueModel], samples: Samples) -> None:
    plain, calibrated = calibration_pair
    assert calibrated.calibration == Calibration(FACTOR)
    query = samples.q + 0.3, samples.dq, 2 * samples.ddq
    one, other = (model.predict(*query, covariance=True) for model in calibration_pair)
    assert_close(other.tau, one.tau)
    assert_close(other.noise_std, one.noise_std)
    unexpressed = on_last_diagonal(plain.posterior.misfit.variance(Motion.from_arrays(*query)))
    assert_close(other.covariance - unexpressed, FACTOR**2 * (one.covariance - unexpressed))
    assert_close(other.tau_std**2, other.covariance.diagonal(axis1=1, axis2=2))
    assert (one.tau_std > 0).all()


def test_calibration_scales_components(calibration_pair: tuple[TorqueModel, TorqueModel], samples: Samples) -> None:
    motion, tau = samples.motion()[10:15], samples.tau[10:15]
    one, other = (dynamics.components(m, motion, dynamics.COMPONENTS, tau) for m in calibration_pair)
    for name in dynamics.COMPONENTS:
        assert_close(other[name].mean, one[name].mean)
        if name == "without_gravity":
            unexpressed = calibration_pair[0].posterior.misfit.variance(motion)
            assert_close(other[name].std ** 2 - unexpressed, FACTOR**2 * (one[name].std ** 2 - unexpressed))
        elif name != "forward_dynamics":  # its std includes the misfit
            assert_close(other[name].std, FACTOR * one[name].std)
        assert (one[name].std > 0).any(), name


def test_calibration_scales_parameters(calibration_pair: tuple[TorqueModel, TorqueModel]) -> None:
    one, other = (friction_coefficients(m.posterior, m.estimator) for m in calibration_pair)
    for name in ("viscous", "coulomb", "offset"):
        assert_close(getattr(other, name), getattr(one, name))
        assert_close(getattr(other, f"{name}_std"), FACTOR * getattr(one, f"{name}_std"))
    if calibration_pair[0].robot is not None:
        bodies, scaled = (inertial_parameters(m.posterior, m.estimator) for m in calibration_pair)
        assert_close(scaled.mean, bodies.mean)
        assert_close(scaled.std, FACTOR * bodies.std)
        weights, more = (weight_posterior(m.posterior, m.estimator.terms["rigid_body"]) for m in calibration_pair)
        assert np.array_equal(weights.scale, more.scale)  # of the prior


def test_calibration_factor_is_saved_and_loaded(
    calibration_pair: tuple[TorqueModel, TorqueModel], tmp_path: Path
) -> None:
    _, calibrated = calibration_pair
    assert save(calibrated, tmp_path / "model")["calibration"] == {"function_std_factor": FACTOR}
    assert load(tmp_path / "model").calibration == calibrated.calibration
    # the saved factor counts, not the estimator's current one
    assert calibrate(calibrated.estimator.name).function_std_factor != FACTOR


@pytest.mark.parametrize("factor", [0.999, 0.0, -2.0, float("nan"), float("inf"), 100.0])
def test_factor_out_of_range_is_rejected(factor: float) -> None:
    with pytest.raises(ValueError, match=f"function_std_factor is {factor!r}, expected a number from 1 to 100"):
        Calibration(factor)

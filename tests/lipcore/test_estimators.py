"""Every estimator that can be chosen: it fits and predicts, survives awkward data, and is calibrated by one factor."""

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
from lipcore.kernels.arm_prior import Arm, arm_of_robot
from lipcore.kernels.base import on_last_diagonal
from lipcore.model import dynamics
from lipcore.model.parameters import friction_coefficients, inertial_parameters, weight_posterior
from lipcore.posterior.exact import negative_log_evidence
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from lipcore.robots.urdf import RigidBody
from lipcore.training import fit
from lipcore.vocabulary import ROBOT_ESTIMATORS

ROBOT = "double-pendulum"
TYPES = ("revolute", "revolute")
OPTIONS = FitOptions(hyperparameter_samples=40, max_iterations=40, starts=1, device="cpu")
every_estimator = pytest.mark.parametrize("name", ESTIMATORS)


def recorded(noise: float = 0.002, seed: int = 1) -> Samples:
    return simulate(load_robot(ROBOT), Simulation(n_samples=60, speed=10, noise=noise, viscous=0.05), seed)


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
    figures = evaluate(unseen.tau, *answer.interval)
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


SMALL = FitOptions(
    hyperparameter_samples=20, posterior_samples=50, max_iterations=10, starts=1, device="cpu", statistics="chosen"
)


@pytest.fixture(scope="module")
def samples() -> Samples:
    return recorded(noise=1e-4)


@pytest.fixture(scope="module")
def model(samples: Samples) -> TorqueModel:
    return train(samples, TYPES, "lip-chain", SMALL)


def test_answer_for_many_is_the_answers_for_each(model: TorqueModel, samples: Samples) -> None:
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


def test_bad_argument_of_training_is_named(samples: Samples) -> None:
    good = {"joint_types": TYPES, "estimator": "lip-chain", "options": SMALL}
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
            train(replace(samples, **{name: values}), TYPES, "lip-chain", SMALL)


FACTOR = 1.75
SAME = 1e-6
"""Share of the largest number by which two fits to the same samples may differ."""
ZERO = FitOptions(hyperparameter_samples=30, max_iterations=20, starts=1, device="cpu", prior="zero")


@pytest.fixture(scope="module", params=["lip-chain", "lip", "rigid-body"])
def plain(request: pytest.FixtureRequest, samples: Samples) -> TorqueModel:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit, "calibrate", lambda name: NO_CALIBRATION)
        return trained(request.param, samples, ZERO)


@pytest.fixture(scope="module")
def corrected(plain: TorqueModel, samples: Samples) -> TorqueModel:
    """The same training, with a factor for its estimator."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(FUNCTION_STD_FACTOR, plain.estimator.name, FACTOR)
        return trained(plain.estimator.name, samples, ZERO)


def alike(found: ArrayLike, expected: ArrayLike) -> None:
    """Assert that what two fits say is the same but for rounding, which the steps of a search magnify."""
    np.testing.assert_allclose(found, expected, rtol=0, atol=SAME * np.abs(np.asarray(expected)).max())


def test_predictions(plain: TorqueModel, corrected: TorqueModel, samples: Samples) -> None:
    assert corrected.calibration == Calibration(FACTOR)
    query = samples.q + 0.3, samples.dq, 2 * samples.ddq
    one, other = (model.predict(*query, covariance=True) for model in (plain, corrected))
    alike(other.tau, one.tau)
    alike(other.noise_std, one.noise_std)
    unexpressed = on_last_diagonal(plain.posterior.misfit.variance(Motion.from_arrays(*query)))
    alike(other.covariance - unexpressed, FACTOR**2 * (one.covariance - unexpressed))
    alike(other.tau_std**2, other.covariance.diagonal(axis1=1, axis2=2))
    assert (one.tau_std > 0).all()


def test_components(plain: TorqueModel, corrected: TorqueModel, samples: Samples) -> None:
    motion, tau = samples.motion()[10:15], samples.tau[10:15]
    one, other = (dynamics.components(m, motion, dynamics.COMPONENTS, tau) for m in (plain, corrected))
    for name in dynamics.COMPONENTS:
        alike(other[name].mean, one[name].mean)
        if name != "forward_dynamics":  # which has what no estimator expresses besides
            alike(other[name].std, FACTOR * one[name].std)
        assert (one[name].std > 0).any(), name


def test_parameters(plain: TorqueModel, corrected: TorqueModel) -> None:
    one, other = (friction_coefficients(m.posterior, m.estimator) for m in (plain, corrected))
    for name in ("viscous", "coulomb", "offset"):
        alike(getattr(other, name), getattr(one, name))
        alike(getattr(other, f"{name}_std"), FACTOR * getattr(one, f"{name}_std"))
    if plain.robot is not None:
        bodies, scaled = (inertial_parameters(m.posterior, m.estimator) for m in (plain, corrected))
        alike(scaled.mean, bodies.mean)
        alike(scaled.std, FACTOR * bodies.std)
        weights, more = (weight_posterior(m.posterior, m.estimator.terms["rigid_body"]) for m in (plain, corrected))
        assert np.array_equal(weights.scale, more.scale)  # the prior's own


def test_its_factor_is_saved_and_loaded(corrected: TorqueModel, tmp_path: Path) -> None:
    manifest = save(corrected, tmp_path / "model")
    assert manifest["calibration"] == {"function_std_factor": FACTOR}
    again = load(tmp_path / "model")
    assert again.calibration == corrected.calibration
    # what a model was saved with counts, not what its estimator has by now
    assert calibrate(corrected.estimator.name).function_std_factor != FACTOR


@pytest.mark.parametrize("factor", [0.999, 0.0, -2.0, float("nan"), float("inf"), 100.0])
def test_factor_out_of_range_is_refused(factor: float) -> None:
    with pytest.raises(ValueError, match=f"function_std_factor is {factor!r}, expected a number from 1 to 100"):
        Calibration(factor)

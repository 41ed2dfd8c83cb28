"""Tests of the fallback for torques that the training does not determine."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lipcore import FitOptions, Samples, TorqueModel, load, save, train
from lipcore.data.motion import Motion
from lipcore.kernels.friction import FrictionKernel
from lipcore.kernels.geometry import Geometry
from lipcore.kernels.payload import PayloadKernel
from lipcore.model.payload import Carrier
from lipcore.model.torque_model import training_torque
from lipcore.model.warnings import warnings
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from lipcore.online.transfer import Revision, consolidate
from lipcore.posterior.evaluator import QUERIES
from lipcore.robots.library import Robot, load_robot
from lipcore.robots.simulation import Simulation, simulate
from lipcore.robots.urdf import RigidBody
from tests.lipcore.arm_oracles import arm, train_from_geometry
from tests.lipcore.model.test_declared_payload import BODY

PENDULUM, CHAIN = load_robot("double-pendulum"), arm("RRR", 31)[2]
TRAINING_CASES = {"rigid-body": (PENDULUM, 0.2, 3), "lip-chain": (CHAIN, 0.5, 1)}
"""By estimator: robot, speed of training relative to the simulation's default, and seed."""
QUERY_SPEED = 10.0
"""Relative speed of the queries."""


def simulate_motion(robot: Robot, speed: float, seconds: float, seed: int) -> Samples:
    """Simulate motion at 50 Hz with friction."""
    stream = Simulation(int(50 * seconds), 50.0, speed=speed, noise=0.05, viscous=0.3, coulomb=0.2, motion="full")
    return simulate(robot, stream, seed)


@pytest.fixture(scope="module", params=TRAINING_CASES)
def estimator(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def training_samples(estimator: str) -> Samples:
    robot, speed, seed = TRAINING_CASES[estimator]
    return simulate_motion(robot, speed, 3.0, seed)


@pytest.fixture(scope="module")
def fast_motion(estimator: str) -> Samples:
    robot, _, seed = TRAINING_CASES[estimator]
    return simulate_motion(robot, QUERY_SPEED, 10.0, seed + 10)


@pytest.fixture(scope="module")
def model(estimator: str, training_samples: Samples) -> TorqueModel:
    if estimator == "rigid-body":
        body = RigidBody.from_profile("double-pendulum", PENDULUM.joint_names, PENDULUM.joint_types)
        return train_from_geometry(Geometry.from_robot(body), PENDULUM, training_samples, FitOptions(device="cpu"))
    options = FitOptions(hyperparameter_samples=50, max_iterations=20, starts=1, device="cpu")
    return train(training_samples, CHAIN.joint_types, estimator, options)


def dense(model: TorqueModel, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Return torques and fallback shares by the formulas of docs/method.md, section 9, (N, n)."""
    assert model.training_torque is not None
    centre, usual = np.array(model.training_torque["mean"]), np.square(model.training_torque["std"])
    still = replace(motion, dq=np.zeros_like(motion.dq), ddq=np.zeros_like(motion.ddq))
    mean, variance, _ = condition(model, motion, motion)
    static, uncertain, payload = condition(model, still, motion)
    share, own = (np.clip((each / usual - 1) / 2, 0, 1) for each in (variance, uncertain))
    harmless = static + own * (centre + payload - static)
    return mean + share * (harmless - mean), share


def condition(model: TorqueModel, motion: Motion, moving: Motion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return posterior mean, variance, and the payload's part of the mean, (N, n) each.

    moving: the motion that friction and payload depend on.
    """
    posterior, n = model.posterior, model.n_joints
    parts: list[np.ndarray] = []
    mean, prior, payload = np.zeros(motion.q.shape), np.zeros(motion.q.size), np.zeros(motion.q.shape)
    if posterior.basis.term is not None:
        term = posterior.basis.term
        parts.append(term.gram(posterior.params, posterior.basis.inducing, motion)[posterior.basis.outputs])
        variance = term.variance(posterior.params, motion)
        prior += np.diagonal(variance, axis1=1, axis2=2).reshape(-1)
    for kernel in posterior.basis.linear:
        moves = isinstance(kernel, FrictionKernel | PayloadKernel)
        features = kernel.features(moving if moves else motion).reshape(-1, len(kernel.variances(posterior.params)))
        covariance = (features * kernel.variances(posterior.params)).T
        weights = kernel.prior_weights()
        if weights is not None:
            mean += (features @ weights).reshape(-1, n)
        if isinstance(kernel, PayloadKernel):
            payload += (posterior.weights[posterior.basis.rows(kernel)] @ covariance).reshape(-1, n)
        parts.append(covariance)
    cross, chosen = np.concatenate(parts), len(posterior.basis.outputs)
    mean += (posterior.weights @ cross).reshape(-1, n)
    whitened = np.square(posterior.root @ cross)
    variance = posterior.std_factor**2 * (prior - whitened[:chosen].sum(0) + whitened[chosen:].sum(0))
    return mean, variance.reshape(-1, n), payload


def test_predictions_match_the_formulas(model: TorqueModel, fast_motion: Samples) -> None:
    motion = fast_motion.motion()[:: len(fast_motion) // (2 * QUERIES + 3)]
    tau, share = dense(model, motion)
    answer = model.predict(motion.q, motion.dq, motion.ddq)
    assert answer.fallback is not None
    assert (share == 1).any()
    assert ((share > 0) & (share < 1)).any()
    np.testing.assert_allclose(answer.fallback.share, share, atol=1e-6)
    np.testing.assert_allclose(answer.tau, tau, rtol=1e-6, atol=1e-6 * np.abs(tau).max())


@pytest.mark.parametrize("estimator", ["rigid-body"], indirect=True)
def test_payload_is_added_to_the_fallback(model: TorqueModel, fast_motion: Samples) -> None:
    motion, carrier = fast_motion.motion()[:60], Carrier(model)
    carrying = carrier.with_payload(carrier.known(BODY.parameters))
    tau, share = dense(carrying, motion)
    answer = carrying.predict(motion.q, motion.dq, motion.ddq)
    assert (share > 0).any()
    np.testing.assert_allclose(answer.tau, tau, rtol=1e-6, atol=1e-6 * np.abs(tau).max())


def test_single_query_equals_its_row_of_a_batch(model: TorqueModel, fast_motion: Samples) -> None:
    motions = fast_motion.motion()[: 2 * QUERIES + 3].arrays()
    many = model.predict(*motions.transpose(1, 0, 2), covariance=True)
    assert many.fallback is not None
    assert many.covariance is not None
    for k, motion in enumerate(motions):
        one = model.answer_fully(motion, covariance=True)
        assert np.array_equal(one.tau, many.tau[k])
        assert np.array_equal(one.covariance, many.covariance[k])
        share = np.zeros(model.n_joints) if one.fallback is None else one.fallback.share
        assert np.array_equal(share, many.fallback.share[k])
        for std in (True, False):
            assert np.array_equal(model.answer(motion, std)[0], many.tau[k])


def test_fallback_keeps_posterior_means_and_standard_deviations(model: TorqueModel, fast_motion: Samples) -> None:
    never = replace(model, training_torque=None)
    found, expected = (
        each.predict(fast_motion.q, fast_motion.dq, fast_motion.ddq, covariance=True) for each in (model, never)
    )
    assert expected.fallback is None
    assert found.fallback is not None
    assert np.array_equal(found.tau_std, expected.tau_std)
    assert np.array_equal(found.covariance, expected.covariance)
    assert np.array_equal(found.fallback.mean, expected.tau)
    untouched = found.fallback.share == 0
    assert np.array_equal(found.tau[untouched], expected.tau[untouched])


def test_recorded_motion_needs_no_fallback(model: TorqueModel, training_samples: Samples) -> None:
    answer = model.predict(training_samples.q, training_samples.dq, training_samples.ddq)
    assert answer.fallback is None
    assert np.array_equal(
        answer.tau, model.evaluator.many(training_samples.q, training_samples.dq, training_samples.ddq)[0]
    )


def test_prediction_is_continuous_outside_the_data(model: TorqueModel, training_samples: Samples) -> None:
    start, largest = training_samples.motion()[10:11], []
    for count in (3001, 12001):
        scale = np.linspace(1.0, 30.0, count)[:, None]
        q = np.repeat(start.q, count, axis=0)
        answer = model.predict(q, scale * start.dq, scale**2 * start.ddq)
        assert answer.fallback is not None
        assert answer.fallback.share[0].max() == 0
        assert answer.fallback.share[-1].max() == 1
        largest.append([np.abs(np.diff(each, axis=0)).max() for each in (answer.tau, answer.fallback.share)])
    coarse, fine = np.array(largest)
    assert (fine < 0.3 * coarse).all()  # a jump would stay as large


@pytest.mark.parametrize("estimator", ["rigid-body"], indirect=True)
def test_fallback_is_no_worse_than_the_mean(
    model: TorqueModel, training_samples: Samples, fast_motion: Samples
) -> None:
    answer, never = (
        each.predict(fast_motion.q, fast_motion.dq, fast_motion.ddq).tau
        for each in (model, replace(model, training_torque=None))
    )
    of_mean = np.mean((training_samples.tau.mean(0) - fast_motion.tau) ** 2, axis=0)
    found, before = (np.mean((tau - fast_motion.tau) ** 2, axis=0) / of_mean for tau in (answer, never))
    assert before.max() > 1.5
    assert found.max() < 1.05


def test_joints_with_fallback_are_named(model: TorqueModel) -> None:
    assert model.training_torque is not None
    std = np.full(model.n_joints, 1e6)
    certain = replace(model, training_torque={**model.training_torque, "std": std.tolist()})
    std[1] = 0.0
    doubtful = replace(model, training_torque={**model.training_torque, "std": std.tolist()})
    texts, none = (warnings(each, {}) for each in (doubtful, certain))
    assert texts[1:] == none
    assert f"the torque of {model.joint_names[1]} falls back to gravity and friction" in texts[0]


def test_fallback_is_saved_and_absent_in_older_models(model: TorqueModel, fast_motion: Samples, tmp_path: Path) -> None:
    save(model, tmp_path / "new")
    again = load(tmp_path / "new")
    assert again.training_torque == model.training_torque
    expected = model.predict(fast_motion.q, fast_motion.dq, fast_motion.ddq).tau
    np.testing.assert_allclose(
        again.predict(fast_motion.q, fast_motion.dq, fast_motion.ddq).tau, expected, rtol=1e-6, atol=1e-6
    )
    manifest = save(replace(model, training_torque=None), tmp_path / "old")
    assert "training_torque" not in manifest
    assert load(tmp_path / "old").predict(fast_motion.q, fast_motion.dq, fast_motion.ddq).fallback is None


def test_joint_with_constant_torque_returns_its_mean(model: TorqueModel, training_samples: Samples) -> None:
    torque = training_torque(training_samples.tau)
    torque["std"][1] = 0.0
    answer = replace(model, training_torque=torque).predict(
        training_samples.q, training_samples.dq, training_samples.ddq
    )
    np.testing.assert_array_equal(answer.tau[:, 1], torque["mean"][1])
    assert np.isfinite(answer.tau).all()


@pytest.mark.parametrize("estimator", ["rigid-body"], indirect=True)
def test_learning_ends_the_fallback_and_changes_keep_it_off(model: TorqueModel, fast_motion: Samples) -> None:
    batch = Rows(
        fast_motion.t,
        fast_motion.q,
        fast_motion.dq,
        fast_motion.ddq,
        fast_motion.tau,
        np.zeros(len(fast_motion), np.uint8),
        np.ones(len(fast_motion)),
    )
    online = OnlineModel.start(model).learn(batch)
    before, after = (each.predict(fast_motion.q, fast_motion.dq, fast_motion.ddq) for each in (model, online.model()))
    assert before.fallback is not None
    share = 0.0 if after.fallback is None else after.fallback.share.mean()
    assert share < 0.1 * before.fallback.share.mean()
    for opened in (online.change(1e3), OnlineModel.start(model, forgetting_s=1.0).learn(batch)):
        learnt = opened.model()
        for each in (learnt, consolidate(opened), Revision.of(learnt).apply(model)):
            answer = each.predict(fast_motion.q, fast_motion.dq, fast_motion.ddq)
            assert answer.fallback is None
            np.testing.assert_allclose(
                answer.tau, learnt.predict(fast_motion.q, fast_motion.dq, fast_motion.ddq).tau, rtol=1e-6, atol=1e-6
            )
    again = Revision.of(online.model()).apply(model).predict(fast_motion.q, fast_motion.dq, fast_motion.ddq)
    assert np.array_equal(again.tau, after.tau)

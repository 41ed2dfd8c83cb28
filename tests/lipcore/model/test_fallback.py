"""Tests of the fallback for torques that the training does not determine."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from lipcore import FitOptions, Samples, TorqueModel, TorquePrediction, load, save, train
from lipcore.data.motion import Motion
from lipcore.kernels.drive.kernel import DriveKernel
from lipcore.kernels.geometry import Geometry
from lipcore.kernels.payload import PayloadKernel
from lipcore.model.torque_model import training_torque
from lipcore.model.warnings import warnings
from lipcore.online.learner import OnlineModel
from lipcore.online.transfer import Revision, consolidate
from lipcore.posterior.evaluator import QUERIES
from lipcore.robots.library import Robot, load_robot
from lipcore.robots.simulation import Simulation, inverse_dynamics, simulate
from lipcore.robots.urdf import RigidBody
from tests.lipcore.arm_oracles import arm, as_rows, train_from_geometry
from tests.lipcore.model.test_declared_payload import BODY, declare_payload

PENDULUM, CHAIN = load_robot("double-pendulum"), arm("RRR", 31)[2]


class Case(NamedTuple):
    """A model, the motion that it has learnt, and fast motion of the same robot."""

    model: TorqueModel
    training: Samples
    fast: Samples


def simulate_motion(robot: Robot, speed: float, seconds: float, seed: int) -> Samples:
    """Simulate motion at 50 Hz with friction. speed: relative to the simulation's default."""
    stream = Simulation(int(50 * seconds), 50.0, speed=speed, noise=0.05, viscous=0.3, coulomb=0.2, motion="full")
    return simulate(robot, stream, seed)


def predict(model: TorqueModel, samples: Samples, covariance: bool = False) -> TorquePrediction:
    return model.predict(samples.q, samples.dq, samples.ddq, covariance)


@pytest.fixture(scope="module", params=["rigid-body", "lip-chain"])
def case(request: pytest.FixtureRequest) -> Case:
    robot, speed, seed = (PENDULUM, 0.2, 3) if request.param == "rigid-body" else (CHAIN, 0.5, 1)
    training = simulate_motion(robot, speed, 3.0, seed)
    if robot is PENDULUM:
        geometry = Geometry.from_robot(RigidBody.from_profile(robot.name, robot.joint_names, robot.joint_types))
        model = train_from_geometry(geometry, robot, training, FitOptions(device="cpu"))
    else:
        options = FitOptions(hyperparameter_samples=50, max_iterations=20, starts=1, device="cpu")
        model = train(training, robot.joint_types, request.param, options)
    return Case(model, training, simulate_motion(robot, 10.0, 10.0, seed + 10))


def dense(model: TorqueModel, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Return torques and fallback shares by the formulas of docs/method.md, section 9, (N, n)."""
    centre, usual = np.array(model.training_torque["mean"]), np.square(model.training_torque["std"])
    still = replace(motion, dq=np.zeros_like(motion.dq), ddq=np.zeros_like(motion.ddq))
    mean, variance, _ = condition(model, motion, motion)
    static, uncertain, payload = condition(model, still, motion)
    rest, least, _ = condition(model, still, still)
    share, own, at_rest = (np.clip((each / usual - 1) / 2, 0, 1) for each in (variance, uncertain, least))
    stood = np.abs([model.training_range["dq"][end] for end in ("min", "max")]).max(0) < 0.02
    at_rest[:, ~stood] = 1.0
    harmless = static + own * (rest + at_rest * (centre + payload - rest) - static)
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
        moves = isinstance(kernel, DriveKernel | PayloadKernel)
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


def test_predictions_match_the_formulas(case: Case) -> None:
    motion = case.fast.motion()[:: len(case.fast) // (2 * QUERIES + 3)]
    tau, share = dense(case.model, motion)
    answer = predict(case.model, motion)
    assert (share == 1).any()
    assert ((share > 0) & (share < 1)).any()
    np.testing.assert_allclose(answer.fallback.share, share, atol=1e-6)
    np.testing.assert_allclose(answer.tau, tau, rtol=1e-6, atol=1e-6 * np.abs(tau).max())


@pytest.mark.parametrize("case", ["rigid-body"], indirect=True)
def test_payload_is_added_to_the_fallback(case: Case) -> None:
    motion, carrying = case.fast.motion()[:60], declare_payload(case.model, BODY)
    tau, share = dense(carrying, motion)
    assert (share > 0).any()
    np.testing.assert_allclose(predict(carrying, motion).tau, tau, rtol=1e-6, atol=1e-6 * np.abs(tau).max())


def test_single_query_equals_its_row_of_a_batch(case: Case) -> None:
    model, rows = case.model, case.fast.motion()[: 2 * QUERIES + 3]
    many = predict(model, rows, covariance=True)
    for k, motion in enumerate(rows.arrays()):
        one = model.answer_fully(motion, covariance=True)
        assert np.array_equal(one.tau, many.tau[k])
        assert np.array_equal(one.covariance, many.covariance[k])
        share = np.zeros(model.n_joints) if one.fallback is None else one.fallback.share
        assert np.array_equal(share, many.fallback.share[k])
        for std in (True, False):
            assert np.array_equal(model.answer(motion, std)[0], many.tau[k])


def test_fallback_keeps_posterior_means_and_standard_deviations(case: Case) -> None:
    never = replace(case.model, training_torque=None)
    found, expected = (predict(each, case.fast, covariance=True) for each in (case.model, never))
    assert expected.fallback is None
    assert np.array_equal(found.tau_std, expected.tau_std)
    assert np.array_equal(found.covariance, expected.covariance)
    assert np.array_equal(found.fallback.mean, expected.tau)
    untouched = found.fallback.share == 0
    assert np.array_equal(found.tau[untouched], expected.tau[untouched])


def test_recorded_motion_needs_no_fallback(case: Case) -> None:
    seen = case.training
    answer = predict(case.model, seen)
    assert answer.fallback is None
    assert np.array_equal(answer.tau, case.model.evaluator.many(seen.q, seen.dq, seen.ddq)[0])


def test_prediction_is_continuous_outside_the_data(case: Case) -> None:
    start, largest = case.training.motion()[10:11], []
    for count in (3001, 12001):
        scale = np.linspace(1.0, 30.0, count)[:, None]
        answer = case.model.predict(np.repeat(start.q, count, axis=0), scale * start.dq, scale**2 * start.ddq)
        assert answer.fallback.share[0].max() == 0
        assert answer.fallback.share[-1].max() == 1
        largest.append([np.abs(np.diff(each, axis=0)).max() for each in (answer.tau, answer.fallback.share)])
    coarse, fine = np.array(largest)
    assert (fine < 0.3 * coarse).all()  # a jump would stay as large


@pytest.mark.parametrize("case", ["rigid-body"], indirect=True)
def test_fallback_is_no_worse_than_the_mean(case: Case) -> None:
    tau, models = case.fast.tau, (case.model, replace(case.model, training_torque=None))
    of_mean = np.mean((case.training.tau.mean(0) - tau) ** 2, axis=0)
    found, before = (np.mean((predict(each, case.fast).tau - tau) ** 2, axis=0) / of_mean for each in models)
    assert before.max() > 1.5
    assert found.max() < 1.05


def test_joints_with_fallback_are_named(case: Case) -> None:
    model, std = case.model, np.full(case.model.n_joints, 1e6)
    certain = replace(model, training_torque={**model.training_torque, "std": std.tolist()})
    std[1] = 0.0
    doubtful = replace(model, training_torque={**model.training_torque, "std": std.tolist()})
    texts, none = (warnings(each, {}) for each in (doubtful, certain))
    assert texts[1:] == none
    assert f"the torque of {model.joint_names[1]} falls back to gravity and friction" in texts[0]


def test_fallback_is_saved_and_absent_in_older_models(case: Case, tmp_path: Path) -> None:
    save(case.model, tmp_path / "new")
    again = load(tmp_path / "new")
    assert again.training_torque == case.model.training_torque
    found, expected = (predict(each, case.fast).tau for each in (again, case.model))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
    assert "training_torque" not in save(replace(case.model, training_torque=None), tmp_path / "old")
    assert predict(load(tmp_path / "old"), case.fast).fallback is None


def test_joint_with_constant_torque_returns_its_mean(case: Case) -> None:
    torque = training_torque(case.training.tau)
    torque["std"][1] = 0.0
    answer = predict(replace(case.model, training_torque=torque), case.training)
    np.testing.assert_array_equal(answer.tau[:, 1], torque["mean"][1])
    assert np.isfinite(answer.tau).all()


@pytest.mark.parametrize("case", ["rigid-body"], indirect=True)
def test_learning_ends_the_fallback_and_changes_keep_it_off(case: Case) -> None:
    model, batch = case.model, as_rows(case.fast, 0.0)
    online = OnlineModel.start(model).learn(batch)
    before, after = (predict(each, case.fast) for each in (model, online.model()))
    share = 0.0 if after.fallback is None else after.fallback.share.mean()
    assert share < 0.1 * before.fallback.share.mean()
    for opened in (online.change(1e3), OnlineModel.start(model, forgetting_s=1.0).learn(batch)):
        learnt = opened.model()
        for each in (learnt, consolidate(opened), Revision.of(learnt).apply(model)):
            answer = predict(each, case.fast)
            assert answer.fallback is None
            np.testing.assert_allclose(answer.tau, predict(learnt, case.fast).tau, rtol=1e-6, atol=1e-6)
    assert np.array_equal(predict(Revision.of(online.model()).apply(model), case.fast).tau, after.tau)


def test_joint_that_stood_still_falls_back_to_gravity() -> None:
    """Held poses show gravity; in motion, the answer is gravity and its standard deviation is large."""
    robot, rng = load_robot("double-pendulum"), np.random.default_rng(2)
    q = rng.uniform(-2.0, 2.0, (80, 2))
    still = np.zeros_like(q)
    tau = inverse_dynamics(robot, q, still, still) + rng.normal(0.0, 0.02, q.shape)
    samples = Samples(robot.joint_names, np.arange(80.0), np.arange(80), q, still, still, tau)
    geometry = Geometry.from_robot(RigidBody.from_profile(robot.name, robot.joint_names, robot.joint_types))
    model = train_from_geometry(geometry, robot, samples, FitOptions(device="cpu"))
    posture, fast = rng.uniform(-2.0, 2.0, (20, 2)), np.full((20, 2), 2.0)
    gravity, answer = inverse_dynamics(robot, posture, 0 * fast, 0 * fast), model.predict(posture, fast, 0 * fast)
    assert (answer.fallback.share > 0.5).all()
    np.testing.assert_allclose(answer.tau, gravity, atol=0.1)
    assert (answer.tau_std > np.std(tau, axis=0)).all()
    expected, _ = dense(model, samples.motion()[:20])
    np.testing.assert_allclose(model.predict(q[:20], still[:20], still[:20]).tau, expected, atol=1e-9)
    motion = replace(samples.motion()[:20], dq=fast)
    np.testing.assert_allclose(model.predict(q[:20], fast, still[:20]).tau, dense(model, motion)[0], rtol=1e-6)

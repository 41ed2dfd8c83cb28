"""Torques that the training does not determine: what is answered instead, where, and who is told."""

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
from tests.lipcore.arm_oracles import arm, followed
from tests.lipcore.test_declared_payload import BODY

PENDULUM, CHAIN = load_robot("double-pendulum"), arm("RRR", 31)[2]
SLOW = {"rigid-body": (PENDULUM, 0.2, 3), "lip-chain": (CHAIN, 0.5, 1)}
"""By estimator a robot, the speed at which it is learnt, of the simulation's usual one, and a seed."""
FAST = 10.0
"""Speed at which it is asked."""


def moving(robot: Robot, speed: float, seconds: float, seed: int) -> Samples:
    """Motion at 50 Hz, with friction."""
    stream = Simulation(int(50 * seconds), 50.0, speed=speed, noise=0.05, viscous=0.3, coulomb=0.2, motion="full")
    return simulate(robot, stream, seed)


@pytest.fixture(scope="module", params=SLOW)
def estimator(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def learnt(estimator: str) -> Samples:
    robot, speed, seed = SLOW[estimator]
    return moving(robot, speed, 3.0, seed)


@pytest.fixture(scope="module")
def fast(estimator: str) -> Samples:
    robot, _, seed = SLOW[estimator]
    return moving(robot, FAST, 10.0, seed + 10)


@pytest.fixture(scope="module")
def model(estimator: str, learnt: Samples) -> TorqueModel:
    if estimator == "rigid-body":
        body = RigidBody.from_profile("double-pendulum", PENDULUM.joint_names, PENDULUM.joint_types)
        return followed(Geometry.from_robot(body), PENDULUM, learnt, FitOptions(device="cpu"))
    options = FitOptions(hyperparameter_samples=50, max_iterations=20, starts=1, device="cpu")
    return train(learnt, CHAIN.joint_types, estimator, options)


def dense(model: TorqueModel, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Torques and shares by the formulas of docs/method.md, section 9, from each term's covariances: (N, n)."""
    assert model.training_torque is not None
    centre, usual = np.array(model.training_torque["mean"]), np.square(model.training_torque["std"])
    still = replace(motion, dq=np.zeros_like(motion.dq), ddq=np.zeros_like(motion.ddq))
    mean, variance, _ = conditioned(model, motion, motion)
    static, uncertain, payload = conditioned(model, still, motion)
    share, own = (np.clip((each / usual - 1) / 2, 0, 1) for each in (variance, uncertain))
    harmless = static + own * (centre + payload - static)
    return mean + share * (harmless - mean), share


def conditioned(model: TorqueModel, motion: Motion, moving: Motion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Posterior mean, its variance, and the payload's part of the mean, of N queries, (N, n) each, sample by sample.
    moving: what friction and payload see of the queries."""
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


def test_answers_are_those_of_the_formulas(model: TorqueModel, fast: Samples) -> None:
    motion = fast.motion()[:: len(fast) // (2 * QUERIES + 3)]
    tau, share = dense(model, motion)
    answer = model.predict(motion.q, motion.dq, motion.ddq)
    assert answer.fallback is not None
    assert (share == 1).any()
    assert ((share > 0) & (share < 1)).any()
    np.testing.assert_allclose(answer.fallback.share, share, atol=1e-6)
    np.testing.assert_allclose(answer.tau, tau, rtol=1e-6, atol=1e-6 * np.abs(tau).max())


@pytest.mark.parametrize("estimator", ["rigid-body"], indirect=True)
def test_a_payload_is_added_to_what_is_answered_instead(model: TorqueModel, fast: Samples) -> None:
    motion, carrier = fast.motion()[:60], Carrier(model)
    carrying = carrier.with_payload(carrier.known(BODY.parameters))
    tau, share = dense(carrying, motion)
    answer = carrying.predict(motion.q, motion.dq, motion.ddq)
    assert (share > 0).any()
    np.testing.assert_allclose(answer.tau, tau, rtol=1e-6, atol=1e-6 * np.abs(tau).max())


def test_one_query_is_answered_as_its_row_of_many(model: TorqueModel, fast: Samples) -> None:
    motions = fast.motion()[: 2 * QUERIES + 3].arrays()
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


def test_standard_deviations_and_means_of_the_posterior_stay(model: TorqueModel, fast: Samples) -> None:
    never = replace(model, training_torque=None)
    found, expected = (each.predict(fast.q, fast.dq, fast.ddq, covariance=True) for each in (model, never))
    assert expected.fallback is None
    assert found.fallback is not None
    assert np.array_equal(found.tau_std, expected.tau_std)
    assert np.array_equal(found.covariance, expected.covariance)
    assert np.array_equal(found.fallback.mean, expected.tau)
    untouched = found.fallback.share == 0
    assert np.array_equal(found.tau[untouched], expected.tau[untouched])


def test_recorded_motion_is_answered_to_the_last_bit_as_before(model: TorqueModel, learnt: Samples) -> None:
    answer = model.predict(learnt.q, learnt.dq, learnt.ddq)
    assert answer.fallback is None
    assert np.array_equal(answer.tau, model.evaluator.many(learnt.q, learnt.dq, learnt.ddq)[0])


def test_the_answer_has_no_jump_on_the_way_out_of_the_data(model: TorqueModel, learnt: Samples) -> None:
    start, largest = learnt.motion()[10:11], []
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
def test_no_joint_is_worse_than_the_mean_of_the_recording(model: TorqueModel, learnt: Samples, fast: Samples) -> None:
    answer, never = (
        each.predict(fast.q, fast.dq, fast.ddq).tau for each in (model, replace(model, training_torque=None))
    )
    of_mean = np.mean((learnt.tau.mean(0) - fast.tau) ** 2, axis=0)
    found, before = (np.mean((tau - fast.tau) ** 2, axis=0) / of_mean for tau in (answer, never))
    assert before.max() > 1.5
    assert found.max() < 1.05


def test_joints_that_fall_back_beyond_the_recording_are_named(model: TorqueModel) -> None:
    assert model.training_torque is not None
    std = np.full(model.n_joints, 1e6)
    certain = replace(model, training_torque={**model.training_torque, "std": std.tolist()})
    std[1] = 0.0
    doubtful = replace(model, training_torque={**model.training_torque, "std": std.tolist()})
    told, none = (warnings(each, {}) for each in (doubtful, certain))
    assert told[1:] == none
    assert f"the torque of {model.joint_names[1]} is only gravity and friction" in told[0]


def test_a_model_keeps_it_on_disk_and_one_of_an_earlier_release_has_none(
    model: TorqueModel, fast: Samples, tmp_path: Path
) -> None:
    save(model, tmp_path / "new")
    again = load(tmp_path / "new")
    assert again.training_torque == model.training_torque
    expected = model.predict(fast.q, fast.dq, fast.ddq).tau
    np.testing.assert_allclose(again.predict(fast.q, fast.dq, fast.ddq).tau, expected, rtol=1e-6, atol=1e-6)
    manifest = save(replace(model, training_torque=None), tmp_path / "old")
    assert "training_torque" not in manifest
    assert load(tmp_path / "old").predict(fast.q, fast.dq, fast.ddq).fallback is None


def test_a_joint_whose_torque_never_varied_answers_its_mean(model: TorqueModel, learnt: Samples) -> None:
    torque = training_torque(learnt.tau)
    torque["std"][1] = 0.0
    answer = replace(model, training_torque=torque).predict(learnt.q, learnt.dq, learnt.ddq)
    np.testing.assert_array_equal(answer.tau[:, 1], torque["mean"][1])
    assert np.isfinite(answer.tau).all()


@pytest.mark.parametrize("estimator", ["rigid-body"], indirect=True)
def test_learning_ends_it_and_a_change_or_forgetting_does_not_begin_it(model: TorqueModel, fast: Samples) -> None:
    batch = Rows(fast.t, fast.q, fast.dq, fast.ddq, fast.tau, np.zeros(len(fast), np.uint8), np.ones(len(fast)))
    online = OnlineModel.start(model).learn(batch)
    before, after = (each.predict(fast.q, fast.dq, fast.ddq) for each in (model, online.model()))
    assert before.fallback is not None
    share = 0.0 if after.fallback is None else after.fallback.share.mean()
    assert share < 0.1 * before.fallback.share.mean()
    for opened in (online.change(1e3), OnlineModel.start(model, forgetting_s=1.0).learn(batch)):
        learnt = opened.model()
        for each in (learnt, consolidate(opened), Revision.of(learnt).apply(model)):
            answer = each.predict(fast.q, fast.dq, fast.ddq)
            assert answer.fallback is None
            np.testing.assert_allclose(answer.tau, learnt.predict(fast.q, fast.dq, fast.ddq).tau, rtol=1e-6, atol=1e-6)
    again = Revision.of(online.model()).apply(model).predict(fast.q, fast.dq, fast.ddq)
    assert np.array_equal(again.tau, after.tau)

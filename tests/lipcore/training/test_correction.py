"""Tests of the local correction: its kernel, where it is learnt, and that the arm stays unchanged."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from scipy import optimize
from scipy.spatial.distance import cdist

from lipcore import FitOptions, Samples, TorquePrediction, load, save, train
from lipcore.data.splits import SplitRows
from lipcore.estimators.task import Task
from lipcore.kernels.residual import JointResidual, ResidualKernel, residual_inputs
from lipcore.model.selection import selection
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import inverse_dynamics
from lipcore.robots.urdf import RigidBody
from lipcore.training import centres, correction, lengthscales, residual_fit
from lipcore.training.centres import Centres
from lipcore.training.correction import corrected_joints, held_out_blocks
from lipcore.training.lengthscales import Shape
from lipcore.training.refit import refit, relearn, widen_intervals
from lipcore.training.residual_fit import JointFit, learn_weights
from lipcore.training.train import fit_model

ARM, TYPES = "finger-edu", ("revolute",) * 3
OPTIONS = FitOptions(posterior_samples=150, device="cpu", geometry="fixed", statistics="chosen")
RIPPLED_JOINT = 1
"""Joint whose gear ripples."""
PERIOD = 4.0
NOISE = 5e-4


def simulate_ripple(seconds=40.0, ripple=0.02, start=0.0, seed=0, noise=NOISE) -> Samples:
    """Simulate a motion that repeats, with a ripple in one joint's torque."""
    robot, t = load_robot(ARM), start + np.arange(0.0, seconds, 0.05)
    rates = 2 * np.pi / PERIOD * np.array([[1, 2, 3], [2, 1, 1]])
    phases = rates * t[:, None, None] + np.array([[0.3, 1.0, 2.0], [0.7, 0.1, 0.5]])
    sizes = np.array([[0.5, 0.4, 0.3], [0.2, 0.3, 0.3]])
    q, dq = (sizes * np.sin(phases)).sum(1), (sizes * rates * np.cos(phases)).sum(1)
    ddq = -(sizes * rates**2 * np.sin(phases)).sum(1)
    tau = inverse_dynamics(robot, q, dq, ddq) + noise * np.random.default_rng(seed).standard_normal(q.shape)
    tau[:, RIPPLED_JOINT] += ripple * np.sin(12 * q[:, RIPPLED_JOINT])
    return Samples(robot.joint_names, t, np.zeros(len(t), np.int64), q, dq, ddq, tau)


def train_corrected(samples: Samples, estimator="rigid-body+local", **options):
    return train(samples, TYPES, estimator, options=replace(OPTIONS, **options), robot=make_task(samples).robot)


def make_task(samples: Samples) -> Task:
    return Task(samples, TYPES, OPTIONS, robot=RigidBody.from_profile(ARM, samples.joint_names, TYPES))


def predict(model, samples: Samples) -> TorquePrediction:
    return model.predict(samples.q, samples.dq, samples.ddq)


def rmse_per_joint(model, samples: Samples) -> np.ndarray:
    return np.sqrt(np.mean(np.square(predict(model, samples).tau - samples.tau), axis=0))


@pytest.fixture(scope="module")
def local_and_arm():
    samples = simulate_ripple()
    return train_corrected(samples), train_corrected(samples, "rigid-body")


@pytest.mark.slow
def test_repeated_error_is_corrected_only_where_seen(local_and_arm):
    fit = local_and_arm[0].fit
    assert corrected_joints(fit) == [RIPPLED_JOINT]
    assert fit[f"local_{RIPPLED_JOINT + 1}"] < 0.2
    corrected, uncorrected = (rmse_per_joint(each, simulate_ripple(8.0, start=100.0, seed=1)) for each in local_and_arm)
    assert corrected[RIPPLED_JOINT] < 0.3 * uncorrected[RIPPLED_JOINT]
    others = np.arange(3) != RIPPLED_JOINT
    assert corrected[others] == pytest.approx(uncorrected[others], rel=1e-6)
    far = simulate_ripple(8.0, start=3.0)
    far = replace(far, q=far.q + 4.0, dq=-far.dq)
    found, expected = (predict(each, far) for each in local_and_arm)
    np.testing.assert_allclose(found.tau, expected.tau, rtol=0, atol=1e-6)
    spread, other = (np.hypot(each.tau_std, each.noise_std) for each in (found, expected))
    assert (spread > 0.98 * other).all()


def test_saved_correction_predicts_the_same(local_and_arm, tmp_path):
    save(local_and_arm[0], tmp_path / "model")
    again, samples = load(tmp_path / "model"), simulate_ripple(8.0, start=100.0)
    for before, after in zip(
        predict(local_and_arm[0], samples).interval, predict(again, samples).interval, strict=True
    ):
        np.testing.assert_array_equal(before, after)


def test_correction_of_one_joint_is_that_of_a_dense_gaussian_process():
    samples = simulate_ripple(15.0)
    inputs, values = residual_inputs(samples.motion()), np.sin(5 * samples.q[:, 0])
    weights = np.random.default_rng(0).uniform(0.3, 1.0, len(values))
    shape = Shape(np.full(12, 1.5), 0.8, 0.02, 100.0)
    fit = JointFit.of(inputs, values, weights, held_out_blocks(samples), shape, 0.0, np.arange(len(values)))
    joint, stretch = fit.residual(), fit.noise / shape.noise
    queries = simulate_ripple(4.0, start=17.0).motion()
    gram, cross = (
        0.8 * np.exp(-0.5 * cdist(each / 1.5, inputs / 1.5, "sqeuclidean"))
        for each in (inputs, residual_inputs(queries))
    )
    noisy = gram + np.diag(0.02 / weights)
    none = JointResidual.none(3)
    kernel = ResidualKernel([joint, none, none])
    mean, features = kernel.mean(queries), kernel.features(queries)[:, 0]
    learnt = np.linalg.solve(np.eye(len(fit.a)) + fit.a, features.T)
    variance = kernel.beyond(queries)[:, 0] + np.einsum("ij,ji->i", features, learnt)
    expected = cross @ np.linalg.solve(noisy, values)
    np.testing.assert_allclose(mean[:, 0], expected, atol=2e-3)  # OPTIONS.open_share of the variance is left out
    left = 0.8 - np.einsum("ij,ji->i", cross, np.linalg.solve(noisy, cross.T))
    np.testing.assert_allclose(variance, stretch * left, atol=2e-3 * stretch)
    again, _ = learn_weights(replace(joint, weights=0 * joint.weights), inputs, values, weights, fit.noise)
    np.testing.assert_allclose(ResidualKernel([again, none, none]).mean(queries)[:, 0], expected, atol=2e-3)


def test_sums_of_chunks_are_those_of_all_samples(monkeypatch):
    samples = simulate_ripple(15.0)
    inputs, values = residual_inputs(samples.motion()), np.sin(5 * samples.q[:, 0])
    shape = Shape(np.full(12, 1.5), 0.8, 0.02, 100.0)
    every = np.arange(len(values))

    def fit() -> JointFit:
        return JointFit.of(inputs, values, np.ones(len(values)), held_out_blocks(samples), shape, 0.0, every[::2])

    whole = fit()
    for module in (centres, residual_fit):
        monkeypatch.setattr(module, "CHUNK", 7)
    pieces = fit()
    places = {tuple(row) for row in (inputs[::2] / 1.5).astype(np.float32).tolist()}
    assert {tuple(row) for row in whole.centres.places.tolist()} <= places
    np.testing.assert_allclose(pieces.a, whole.a, rtol=1e-5, atol=1e-6)  # features in single precision
    np.testing.assert_allclose(pieces.held_out, whole.held_out, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(pieces.residual().weights, whole.residual().weights, rtol=1e-3, atol=1e-3)


def test_each_block_is_predicted_from_the_others():
    samples = simulate_ripple(15.0)
    some = np.arange(0, len(samples), 3)
    inputs, values = residual_inputs(samples.motion())[some], samples.tau[some, 0]
    gram, noise = np.exp(-0.5 * cdist(inputs, inputs, "sqeuclidean")), np.linspace(0.1, 0.3, len(some))
    blocks = centres.blocks_of(some, held_out_blocks(samples))
    found, weights = centres.predict_held_out(gram, values, noise, blocks)
    np.testing.assert_allclose((gram + np.diag(noise)) @ weights, values, rtol=1e-8, atol=1e-10)
    assert [len(found[block]) for block, _ in blocks] == [10] * 10
    for block, parts in blocks:
        train = np.flatnonzero(parts.train)
        own = np.linalg.solve(gram[np.ix_(train, train)] + np.diag(noise[train]), values[train])
        np.testing.assert_allclose(found[block], gram[block][:, train] @ own, rtol=1e-8, atol=1e-10)


def test_fast_centres_are_where_others_predict_the_residual():
    """The last part of the motion differs from all others. Its torque must not choose the centres of fast answers."""
    rng = np.random.default_rng(3)
    places = np.concatenate([rng.uniform(-3, 3, (270, 1)), rng.uniform(20, 22, (30, 1))]) @ np.ones((1, 4)) / 2
    values = np.where(places[:, 0] < 0, np.sin(4 * places[:, 0]), 0.0) + np.where(places[:, 0] > 5, 9.0, 0.0)
    rows = np.arange(300)
    blocks = [(slice(k, k + 30), SplitRows((rows < k) | (rows >= k + 30), rows // 30 == k // 30)) for k in rows[::30]]
    _, chosen = Centres.choose(places, np.ones(4), values, np.full(300, 0.01), blocks)
    assert (chosen[:4] < 270).all()
    assert (places[chosen[:4], 0] < 0.5).all()
    assert (chosen >= 270).any()


def test_correction_learns_more_rows_than_its_centres_are_chosen_from(monkeypatch):
    samples, again = simulate_ripple(noise=0.01), simulate_ripple(8.0, start=100.0, noise=0.0)
    monkeypatch.setattr(lengthscales, "OPTIONS", replace(lengthscales.OPTIONS, max_rows=150))
    errors = []
    for rows in (800, 60):
        small = replace(correction.OPTIONS, max_rows=rows, max_candidates=60, max_shape_rows=400)
        monkeypatch.setattr(correction, "OPTIONS", small)
        local = train_corrected(samples)
        assert len(local.posterior.basis.residual.joints[RIPPLED_JOINT].weights) <= 60
        errors.append(rmse_per_joint(local, again)[RIPPLED_JOINT])
    assert errors[0] < 0.7 * errors[1]


@pytest.mark.slow
def test_refit_starts_at_the_lengthscales_of_the_fit_before(local_and_arm, monkeypatch):
    samples, local = simulate_ripple(), local_and_arm[0]
    search = Mock(side_effect=optimize.minimize)
    monkeypatch.setattr(optimize, "minimize", search)
    refit(local, make_task(samples))
    inputs = residual_inputs(samples.motion())
    before = local.posterior.basis.residual.joints[RIPPLED_JOINT].lengthscales
    expected = np.log(before / (inputs.std(axis=0) * np.sqrt(inputs.shape[1])))
    logs = [call.args[1] for call in search.call_args_list]  # those of the arm have another size
    starts = [each[:-2] for each in logs if len(each) == len(expected) + 2]
    assert sum(np.allclose(start, expected) for start in starts) == 1
    assert len(starts) == 1 + 2 * len(lengthscales.OPTIONS.starts)  # the other joints have no residual


@pytest.mark.slow
def test_relearning_needs_the_ripple_to_be_seen(local_and_arm):
    samples, again = simulate_ripple(), simulate_ripple(8.0, start=100.0, seed=1)
    whole, few = (relearn(local_and_arm[0], make_task(samples.rows(slice(rows)))) for rows in (800, 40))
    for model in (whole, relearn(local_and_arm[1], make_task(samples))):
        before = local_and_arm[0] if model is whole else local_and_arm[1]
        assert rmse_per_joint(model, again) == pytest.approx(rmse_per_joint(before, again), rel=0.05)
    assert rmse_per_joint(few, again)[RIPPLED_JOINT] > 5 * rmse_per_joint(whole, again)[RIPPLED_JOINT]


def test_corrected_intervals_keep_their_coverage(local_and_arm):
    again = simulate_ripple(8.0, start=100.0, seed=1)
    assert (predict(local_and_arm[0], again).interval.contains(again.tau).mean(axis=0) > 0.9).all()


def test_correction_leaves_the_arm_unchanged(local_and_arm):
    local, arm = (each.posterior for each in local_and_arm)
    first = len(local.weights) - len(arm.weights)
    np.testing.assert_allclose(local.weights[first:], arm.weights, rtol=1e-6)
    np.testing.assert_allclose(local.weights[:first], 0.0, atol=1e-12)


@pytest.mark.slow
def test_fast_answers_use_fewer_centres_and_state_their_error(local_and_arm, monkeypatch):
    monkeypatch.setattr(centres, "OPTIONS", replace(centres.OPTIONS, features=8, fast=12))
    local, again = train_corrected(simulate_ripple()), simulate_ripple(8.0, start=100.0, seed=1)
    rich, fast, arm = (rmse_per_joint(each, again)[RIPPLED_JOINT] for each in (local, local.fast, local_and_arm[1]))
    assert rich < 0.9 * fast < 0.9 * 0.8 * arm
    shares = [local.fit[f"{prefix}local_{RIPPLED_JOINT + 1}"] for prefix in ("", "fast_")]
    assert shares == pytest.approx(np.square(np.array([rich, fast]) / arm), rel=0.5)
    assert (predict(local.fast, again).interval.contains(again.tau).mean(axis=0) > 0.9).all()
    whole = local_and_arm[0]  # all of its centres are few enough
    np.testing.assert_allclose(predict(whole.fast, again).tau, predict(whole, again).tau, rtol=1e-12)
    assert local_and_arm[1].fast is local_and_arm[1]


@pytest.mark.slow
def test_stream_changes_the_correction(local_and_arm):
    changed, again = simulate_ripple(400.0, 0.03, 100.0, seed=2), simulate_ripple(8.0, 0.03, 900.0)
    rows = Rows(changed.t, changed.q, changed.dq, changed.ddq, changed.tau, np.zeros(len(changed), np.uint8))
    local, arm = (OnlineModel.start(each).learn(rows).model() for each in local_and_arm)
    before, after, without = (rmse_per_joint(each, again)[RIPPLED_JOINT] for each in (local_and_arm[0], local, arm))
    assert after < 0.5 * before
    assert after < 0.2 * without


@pytest.mark.slow
def test_pass_over_all_rows_keeps_the_correction(local_and_arm):
    again, (chosen, arm) = simulate_ripple(8.0, start=100.0, seed=1), local_and_arm
    local = train_corrected(simulate_ripple(), statistics="all")
    assert np.abs(predict(local, again).tau - predict(chosen, again).tau).max() > 1e-9
    after, before, without = (rmse_per_joint(each, again)[RIPPLED_JOINT] for each in (local, chosen, arm))
    assert after < min(1.1 * before, 0.3 * without)


@pytest.mark.slow
@pytest.mark.parametrize("given", [{"ripple": 0.0}, {"seconds": 2.0}])
def test_no_correction_without_residual_or_time(given):
    samples = simulate_ripple(**given)
    local, arm = train_corrected(samples), train_corrected(samples, "rigid-body")
    assert corrected_joints(local.fit) == []
    np.testing.assert_allclose(predict(local, samples).tau, predict(arm, samples).tau)


@pytest.mark.slow
def test_lasting_unrepeated_error_is_not_learnt():
    samples = simulate_ripple(ripple=0.0)
    drift = 0.02 * np.sin(2 * np.pi * samples.t / 37.0)
    tau = samples.tau + np.where(np.arange(3) == RIPPLED_JOINT, drift[:, None], 0.0)
    assert corrected_joints(train_corrected(replace(samples, tau=tau)).fit) == []


@pytest.mark.slow
def test_refit_keeps_corrected_joints_and_widened_intervals():
    samples = simulate_ripple()
    task, rest = make_task(samples), samples.rows(slice(620, None))
    part = fit_model(task.on(samples.rows(slice(600))), "rigid-body+local")
    shifted = replace(rest, tau=rest.tau + np.array([0.0, 0.0, 0.05]))
    wider = widen_intervals(part, shifted)
    whole = refit(wider, task)
    assert corrected_joints(whole.fit) == corrected_joints(part.fit) == [RIPPLED_JOINT]
    assert predict(wider, rest).interval.contains(shifted.tau).mean(axis=0)[2] >= 0.95
    assert whole.fit["widened_3"] == wider.fit["widened_3"] > 2
    assert whole.scale[2] > 2 > refit(part, task).scale[2]


@pytest.mark.slow
def test_refit_of_auto_adds_a_correction():
    samples = simulate_ripple()
    task = make_task(samples)
    part = fit_model(task.on(samples.rows(slice(200))), "rigid-body")
    assert refit(part, task).estimator.name == "rigid-body"  # as requested
    whole = refit(replace(part, selection=selection("rigid-body", "it is the simplest", [])), task)
    assert whole.estimator.name == whole.selection["chosen"] == "rigid-body+local"
    assert whole.selection["reason"].startswith(
        "rigid-body+local replaces rigid-body: it is better on all rows; before"
    )

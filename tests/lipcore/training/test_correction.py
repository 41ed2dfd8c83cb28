"""Tests of the local correction: its kernel, where it is learnt, and that the arm stays unchanged."""

import math
from dataclasses import replace

import numpy as np
import pytest

from lipcore import FitOptions, Samples, TorquePrediction, train
from lipcore.data.motion import Motion
from lipcore.estimators.task import Task
from lipcore.kernels.local import LocalKernel
from lipcore.model.selection import selection
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import inverse_dynamics
from lipcore.robots.urdf import RigidBody
from lipcore.training.correction import corrected_joints
from lipcore.training.refit import refit, widen_intervals
from lipcore.training.train import fit_model

ARM, TYPES = "finger-edu", ("revolute",) * 3
OPTIONS = FitOptions(posterior_samples=150, device="cpu", geometry="fixed", statistics="chosen")
RIPPLED_JOINT = 1
"""Joint whose gear ripples."""
PERIOD = 4.0
NOISE = 5e-4


def simulate_ripple(seconds=40.0, ripple=0.02, start=0.0, seed=0) -> Samples:
    """Simulate a motion that repeats, with a ripple in one joint's torque."""
    robot, t = load_robot(ARM), start + np.arange(0.0, seconds, 0.05)
    rates = 2 * np.pi / PERIOD * np.array([[1, 2, 3], [2, 1, 1]])
    phases = rates * t[:, None, None] + np.array([[0.3, 1.0, 2.0], [0.7, 0.1, 0.5]])
    sizes = np.array([[0.5, 0.4, 0.3], [0.2, 0.3, 0.3]])
    q, dq = (sizes * np.sin(phases)).sum(1), (sizes * rates * np.cos(phases)).sum(1)
    ddq = -(sizes * rates**2 * np.sin(phases)).sum(1)
    tau = inverse_dynamics(robot, q, dq, ddq) + NOISE * np.random.default_rng(seed).standard_normal(q.shape)
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


def test_kernel_matches_its_docstring():
    rng, n = np.random.default_rng(0), 2
    x, y = (Motion(*rng.normal(0, 0.1, (3, rows, n))) for rows in (4, 3))
    params = {"local.log_scale": rng.normal(size=n), "local.log_lengthscales": rng.normal(size=4 * n)}
    inputs = [np.concatenate([each.q, each.dq, each.ddq, np.tanh(each.dq / 0.02)], axis=1) for each in (x, y)]
    lengths, expected = np.exp(params["local.log_lengthscales"]), np.zeros((4, n, 3, n))
    for k, m, i in np.ndindex(4, 3, n):
        distance = sum((inputs[0][k, d] - inputs[1][m, d]) ** 2 / lengths[d] ** 2 for d in range(4 * n))
        expected[k, i, m, i] = math.exp(params["local.log_scale"][i] - 0.5 * distance)
    np.testing.assert_allclose(LocalKernel(n).gram(params, x, y), expected.reshape(4 * n, 3 * n), rtol=1e-12)


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
    far = replace(far, q=far.q + 1.5, dq=-far.dq)
    found, expected = (predict(each, far) for each in local_and_arm)
    np.testing.assert_allclose(found.tau, expected.tau, rtol=0, atol=1e-6)
    spread, other = (np.hypot(each.tau_std, each.noise_std) for each in (found, expected))
    assert (spread > 0.98 * other).all()


def test_corrected_intervals_keep_their_coverage(local_and_arm):
    again = simulate_ripple(8.0, start=100.0, seed=1)
    assert (predict(local_and_arm[0], again).interval.contains(again.tau).mean(axis=0) > 0.9).all()


def test_correction_leaves_the_arm_unchanged(local_and_arm):
    local, arm = (each.posterior for each in local_and_arm)
    np.testing.assert_allclose(local.weights[len(local.basis.outputs) :], arm.weights, rtol=1e-6)


@pytest.mark.slow
def test_pass_over_all_rows_changes_only_the_arm(local_and_arm):
    again, (chosen, arm) = simulate_ripple(8.0, start=100.0, seed=1), local_and_arm
    local = train_corrected(simulate_ripple(), statistics="all")
    outputs = len(local.posterior.basis.outputs)
    np.testing.assert_allclose(local.posterior.weights[:outputs], chosen.posterior.weights[:outputs], rtol=1e-6)
    assert rmse_per_joint(local, again)[RIPPLED_JOINT] < 0.3 * rmse_per_joint(arm, again)[RIPPLED_JOINT]


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

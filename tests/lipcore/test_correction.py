"""The local correction: its kernel against plain loops, where it is learnt, and that it leaves the arm alone."""

import math
from dataclasses import replace

import numpy as np
import pytest

from lipcore.data.motion import Motion
from lipcore.data.samples import Samples
from lipcore.estimators.options import FitOptions
from lipcore.estimators.task import Task
from lipcore.kernels.local import LocalKernel
from lipcore.model.selection import selection
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import inverse_dynamics
from lipcore.robots.urdf import RigidBody
from lipcore.training.correction import corrected_joints
from lipcore.training.refit import refit, widen_intervals
from lipcore.training.train import fit_model, train

ARM, TYPES = "finger-edu", ("revolute",) * 3
OPTIONS = FitOptions(posterior_samples=150, device="cpu", geometry="fixed", statistics="chosen")
RIPPLED = 1
"""The joint whose gear ripples."""
PERIOD = 4.0
NOISE = 5e-4


def recorded(seconds=40.0, ripple=0.02, start=0.0, repeats=True, seed=0) -> Samples:
    """A motion of PERIOD, or of no period, of an arm with a ripple of one joint's torque."""
    robot = load_robot(ARM)
    t = start + np.arange(0.0, seconds, 0.05)
    rates = (
        2
        * np.pi
        / PERIOD
        * (np.array([[1, 2, 3], [2, 1, 1]]) if repeats else np.array([[1, 1.6, 2.2], [2.3, 0.7, 1.3]]))
    )
    phases = rates * t[:, None, None] + np.array([[0.3, 1.0, 2.0], [0.7, 0.1, 0.5]])
    sizes = np.array([[0.5, 0.4, 0.3], [0.2, 0.3, 0.3]])
    q, dq = (sizes * np.sin(phases)).sum(1), (sizes * rates * np.cos(phases)).sum(1)
    ddq = -(sizes * rates**2 * np.sin(phases)).sum(1)
    tau = inverse_dynamics(robot, q, dq, ddq) + NOISE * np.random.default_rng(seed).standard_normal(q.shape)
    tau[:, RIPPLED] += ripple * np.sin(12 * q[:, RIPPLED])
    return Samples(robot.joint_names, t, np.zeros(len(t), np.int64), q, dq, ddq, tau)


def trained(samples: Samples, estimator="rigid-body+local", **options):
    robot = RigidBody.from_profile(ARM, samples.joint_names, TYPES)
    return train(samples, TYPES, estimator, options=replace(OPTIONS, **options), robot=robot)


def error(model, samples: Samples) -> np.ndarray:
    return np.sqrt(np.mean(np.square(model.predict(samples.q, samples.dq, samples.ddq).tau - samples.tau), axis=0))


@pytest.fixture(scope="module")
def both():
    samples = recorded()
    return trained(samples), trained(samples, "rigid-body")


def test_the_kernel_is_what_its_docstring_says():
    rng, n = np.random.default_rng(0), 2
    x, y = (Motion(*rng.normal(0, 0.1, (3, rows, n))) for rows in (4, 3))
    params = {"local.log_scale": rng.normal(size=n), "local.log_lengthscales": rng.normal(size=4 * n)}
    kernel = LocalKernel(n)
    inputs = [np.concatenate([each.q, each.dq, each.ddq, np.tanh(each.dq / 0.02)], axis=1) for each in (x, y)]
    lengths, expected = np.exp(params["local.log_lengthscales"]), np.zeros((4, n, 3, n))
    for k, m, i in np.ndindex(4, 3, n):
        distance = sum((inputs[0][k, d] - inputs[1][m, d]) ** 2 / lengths[d] ** 2 for d in range(4 * n))
        expected[k, i, m, i] = math.exp(params["local.log_scale"][i] - 0.5 * distance)
    np.testing.assert_allclose(kernel.gram(params, x, y), expected.reshape(4 * n, 3 * n), rtol=1e-12)


def test_what_repeats_is_corrected_where_it_was_seen_and_only_there(both):
    local, arm = both
    assert corrected_joints(local.fit) == [RIPPLED]
    assert local.fit[f"local_{RIPPLED + 1}"] < 0.2
    again = recorded(8.0, start=100.0, seed=1)
    assert error(local, again)[RIPPLED] < 0.3 * error(arm, again)[RIPPLED]
    others = np.arange(3) != RIPPLED
    assert error(local, again)[others] == pytest.approx(error(arm, again)[others], rel=1e-6)
    far = recorded(8.0, start=3.0)
    far = replace(far, q=far.q + 1.5, dq=-far.dq)
    answers = [each.predict(far.q, far.dq, far.ddq) for each in both]
    np.testing.assert_allclose(answers[0].tau, answers[1].tau, rtol=0, atol=1e-6)
    spreads = [np.hypot(each.tau_std, each.noise_std) for each in answers]
    assert (spreads[0] > 0.98 * spreads[1]).all()


def test_its_intervals_hold_what_it_predicts(both):
    again = recorded(8.0, start=100.0, seed=1)
    held = both[0].predict(again.q, again.dq, again.ddq).interval.contains(again.tau).mean(axis=0)
    assert (held > 0.9).all()


def test_the_arm_stays_as_it_is(both):
    local, arm = (each.posterior for each in both)
    np.testing.assert_allclose(local.weights[len(local.basis.outputs) :], arm.weights, rtol=1e-6)


def test_a_pass_over_all_rows_teaches_the_arm_alone(both):
    samples, again = recorded(), recorded(8.0, start=100.0, seed=1)
    local = trained(samples, statistics="all")
    outputs = len(local.posterior.basis.outputs)
    np.testing.assert_allclose(local.posterior.weights[:outputs], both[0].posterior.weights[:outputs], rtol=1e-6)
    assert error(local, again)[RIPPLED] < 0.3 * error(both[1], again)[RIPPLED]


@pytest.mark.parametrize("given", [{"ripple": 0.0}, {"seconds": 2.0}])
def test_where_nothing_is_left_over_or_too_little_to_tell_it_answers_as_the_arm(given):
    samples = recorded(**given)
    local, arm = trained(samples), trained(samples, "rigid-body")
    assert corrected_joints(local.fit) == []
    np.testing.assert_allclose(*(each.predict(samples.q, samples.dq, samples.ddq).tau for each in (local, arm)))


def test_what_lasts_but_does_not_come_back_is_not_learnt():
    samples = recorded(ripple=0.0)
    drift = 0.02 * np.sin(2 * np.pi * samples.t / 37.0)
    tau = samples.tau + np.where(np.arange(3) == RIPPLED, drift[:, None], 0.0)
    assert corrected_joints(trained(replace(samples, tau=tau)).fit) == []


def test_the_last_fit_corrects_the_same_joints_and_keeps_how_much_wider_intervals_are():
    samples = recorded()
    robot = RigidBody.from_profile(ARM, samples.joint_names, TYPES)
    task = Task(samples, TYPES, OPTIONS, robot=robot)
    part = fit_model(task.on(samples.rows(slice(600))), "rigid-body+local")
    rest = samples.rows(slice(620, None))
    shifted = replace(rest, tau=rest.tau + np.array([0.0, 0.0, 0.05]))
    wider = widen_intervals(part, shifted)
    whole = refit(wider, task)
    assert corrected_joints(whole.fit) == corrected_joints(part.fit) == [RIPPLED]
    assert wider.predict(rest.q, rest.dq, rest.ddq).interval.contains(shifted.tau).mean(axis=0)[2] >= 0.95
    assert whole.fit["widened_3"] == wider.fit["widened_3"] > 2
    assert whole.scale[2] > 2 > refit(part, task).scale[2]


def test_what_auto_has_not_corrected_is_corrected_if_all_rows_tell_that_it_repeats():
    samples = recorded()
    task = Task(samples, TYPES, OPTIONS, robot=RigidBody.from_profile(ARM, samples.joint_names, TYPES))
    part = fit_model(task.on(samples.rows(slice(200))), "rigid-body")
    assert refit(part, task).estimator.name == "rigid-body"  # as it was asked for
    part = replace(part, selection=selection("rigid-body", "it is the simplest", []))
    whole = refit(part, task)
    assert whole.estimator.name == whole.selection["chosen"] == "rigid-body+local"
    assert whole.selection["reason"].startswith("rigid-body+local replaces rigid-body: of all rows it gains; before")

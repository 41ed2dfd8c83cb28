"""Tests of the learning curve: whether more of the same motion, or other motion, reduces the error."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore import FitOptions, Samples, train
from lipcore.estimators.task import Task
from lipcore.training.learning_curve import LearningCurve, learning_curve

TYPES = ("revolute",) * 2
OPTIONS = FitOptions(hyperparameter_samples=60, posterior_samples=400, max_iterations=15, device="cpu")


def simulate_motion(count, seed, low=-1.0, high=1.0, noise=0.01) -> Samples:
    """Simulate independent states, whose torque is a function of the position with noise."""
    random = np.random.default_rng(seed)
    q = random.uniform(low, high, (count, 2))
    tau = np.stack([np.sin(2 * q.sum(axis=1)), np.cos(2 * q[:, 1])], axis=1)
    tau += noise * random.standard_normal(tau.shape)
    t = 0.1 * np.arange(count)
    return Samples(("one", "two"), t, np.zeros(count, np.int64), q, np.zeros_like(q), np.zeros_like(q), tau)


def compute_curve(samples: Samples, held_out: Samples) -> LearningCurve:
    model = train(samples, TYPES, "se", options=OPTIONS)
    curve = learning_curve(model, Task(samples, TYPES, OPTIONS), held_out)
    assert curve is not None
    return curve


def test_more_samples_of_a_noisy_torque_help():
    curve = compute_curve(simulate_motion(400, 0, noise=0.3), simulate_motion(300, 1, noise=0.0))
    assert [point.rows for point in curve.points] == pytest.approx([100, 200, 200, 400], rel=0.1)
    assert [point.spread for point in curve.points] == [True, True, False, True]
    spread = [point.nmse for point in curve.points if point.spread]
    assert spread == sorted(spread, reverse=True)
    assert curve.more_helps
    assert not curve.variety_helps
    assert curve.text.startswith("More of this motion would help: half of the samples give a squared error")


def test_other_motion_helps_if_the_recording_began_elsewhere():
    first, second = simulate_motion(200, 0, low=-1.0, high=0.0), simulate_motion(200, 1, low=0.0, high=1.0)
    samples = Samples.concatenate([first, replace(second, t=second.t + 20.0)])
    samples = replace(samples, episode=np.zeros(len(samples), np.int64))
    curve = compute_curve(samples, simulate_motion(300, 2))
    assert curve.variety_helps
    assert "Other motion would help: the first half of the samples gives a squared error" in curve.text


def test_learnt_torque_needs_no_more_samples():
    curve = compute_curve(simulate_motion(400, 0), simulate_motion(300, 1))
    assert not curve.more_helps
    assert not curve.variety_helps
    assert curve.text == "More samples would hardly help: half of them give about the same error."


@pytest.mark.parametrize("case", ["short", "constant"])
def test_no_curve_without_pieces_or_torque(case):
    samples, held_out = simulate_motion(200, 0), simulate_motion(100, 1)
    model = train(samples, TYPES, "se", options=OPTIONS)
    if case == "short":
        samples = replace(samples, t=samples.t / 10)
    else:
        held_out = replace(held_out, tau=np.zeros_like(held_out.tau))
    assert learning_curve(model, Task(samples, TYPES, OPTIONS), held_out) is None

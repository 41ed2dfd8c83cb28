"""Tests that rows with closed brakes are left out of training, and rests without torque are kept."""

from dataclasses import replace

import numpy as np
import pytest

import lipcore
from lipcore.data.brakes import find_braked_rows, find_in_samples
from lipcore.estimators.options import FitOptions
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate, usual_torque
from tests.lipcore.braked import close_brakes

OPTIONS = FitOptions(hyperparameter_samples=40, posterior_samples=80, max_iterations=3, starts=1)


def recording(name, size=2500, rate=50.0, friction=0.1, seed=5):
    robot = load_robot(name)
    rubs = (friction * usual_torque(robot)).tolist()
    return simulate(robot, Simulation(size, rate, course="rests", motion="full", coulomb=rubs, viscous=rubs), seed)


@pytest.mark.parametrize(("name", "loaded"), [("panda", {1, 2, 3}), ("ur10", {1}), ("double-pendulum", {0, 1})])
def test_closed_brakes_are_found(name, loaded):
    samples, braked = close_brakes(recording(name))
    found = find_in_samples(samples)
    assert (found.rows & braked).sum() > 0.95 * braked.sum()
    assert (found.rows & ~braked).sum() < 0.05 * braked.sum()
    assert loaded <= set(found.joints)
    assert 0 not in found.joints or name == "double-pendulum"  # about a vertical axis, zero torque at rest is normal


@pytest.mark.parametrize("name", ["panda", "ur10", "tiago", "asr-twodof"])
@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_rests_without_brakes_are_kept(name, friction):
    assert not find_in_samples(recording(name, friction=friction)).rows.any()


def test_brakes_are_unknown_without_times_or_at_long_steps():
    samples, _ = close_brakes(recording("ur10"))
    assert not find_braked_rows(None, samples.episode, 6, lambda *_: samples.tau[:, 0]).rows.any()
    assert not find_in_samples(samples.rows(np.arange(0, len(samples), 5))).joints
    assert not find_in_samples(samples.rows(np.arange(len(samples))[::-1])).joints
    assert not find_in_samples(replace(samples, q=np.zeros_like(samples.q))).joints


def test_training_leaves_out_closed_brakes():
    samples, braked = close_brakes(recording("double-pendulum"))
    fit = lipcore.train(samples, ["revolute"] * 2, "lip", OPTIONS).fit
    assert fit["samples_braked"] == find_in_samples(samples).rows.sum() >= 0.95 * braked.sum()
    assert fit["samples_given"] == len(samples) - fit["samples_braked"]

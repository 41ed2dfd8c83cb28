"""Tests of the last fit: a model trained on part of a recording learns all of it."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore import FitCancelledError
from lipcore.estimators.task import Task
from lipcore.model.selection import selection
from lipcore.model.sibling import arm_of_sibling
from lipcore.online.learner import OnlineModel
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import inverse_dynamics
from lipcore.robots.urdf import RigidBody
from lipcore.training.refit import refit
from lipcore.training.train import fit_model
from tests.choosing import slow
from tests.lipcore.arm_oracles import as_rows
from tests.lipcore.training.test_auto import ARM, OPTIONS, TYPES, simulate_arm

CUT = 140


def simulate_resting_joint():
    """Simulate the arm, whose last joint hardly moves before row CUT."""
    samples, share = simulate_arm(), np.ones((200, 3))
    share[:CUT, 2] = 0.01
    q, dq, ddq = (share * each for each in (samples.q, samples.dq, samples.ddq))
    noise = 0.0005 * np.random.default_rng(0).standard_normal((200, 3))
    return replace(samples, q=q, dq=dq, ddq=ddq, tau=inverse_dynamics(load_robot(ARM), q, dq, ddq) + noise)


def simulate_unseen():
    """Simulate another motion without friction and noise."""
    samples = simulate_arm(seed=8)
    return replace(samples, tau=inverse_dynamics(load_robot(ARM), samples.q, samples.dq, samples.ddq))


def fit_first_part(samples, estimator, options=OPTIONS, **given):
    """Return a task of all samples, and a model of the first CUT of them."""
    task = Task(samples, TYPES, options, **given)
    return task, fit_model(task.on(samples.rows(slice(CUT))), estimator)


def nmse(model, samples):
    error = model.predict(samples.q, samples.dq, samples.ddq).tau - samples.tau
    return np.mean(error**2, axis=0) / samples.tau.var(axis=0)


@pytest.mark.parametrize("estimator", ["rigid-body", "lip-chain", slow("rigid-body+lip-chain")])
def test_refit_learns_unseen_rows(estimator):
    task, part = fit_first_part(simulate_resting_joint(), estimator)
    part = replace(part, selection=selection(estimator, "it was chosen", []))
    whole = refit(part, task)
    assert nmse(whole, simulate_unseen())[2] < 0.6 * nmse(part, simulate_unseen())[2]
    assert whole.estimator.name == part.estimator.name
    assert whole.selection == part.selection
    assert (part.fit["samples_given"], whole.fit["samples_given"]) == (CUT, 200)
    assert whole.fit["seconds"] > part.fit["seconds"]
    assert whole.training_range["dq"]["max"][2] > 10 * part.training_range["dq"]["max"][2]
    report = [key for key in part.fit if key.startswith("search_")]
    assert {key: whole.fit[key] for key in report} == {key: part.fit[key] for key in report}


@pytest.mark.slow
def test_refit_does_not_search(monkeypatch):
    task, part = fit_first_part(simulate_arm(), "rigid-body")
    monkeypatch.setattr("lipcore.arm.learning.search", lambda *_given: pytest.fail("a search began"))
    refit(part, task)


def test_refit_keeps_the_hyperparameters_of_a_chain():
    task, part = fit_first_part(simulate_arm(), "lip-chain")
    whole = refit(part, task)
    for name, value in part.posterior.params.items():
        np.testing.assert_array_equal(whole.posterior.params[name], value)


@pytest.mark.parametrize("geometry", ["fixed", "calibrate"])
def test_refit_stays_around_the_robot(geometry):
    samples = simulate_arm()
    robot = RigidBody.from_profile(ARM, samples.joint_names, TYPES)
    task, part = fit_first_part(samples, "rigid-body", replace(OPTIONS, geometry=geometry), robot=robot)
    whole = refit(part, task)
    assert whole.robot is robot
    assert whole.arm.mode == geometry
    assert (nmse(whole, simulate_arm(seed=8)) < 0.05).all()


@pytest.mark.slow
def test_refit_expects_the_arm_of_its_sibling():
    unit = fit_model(Task(simulate_arm(seed=5), TYPES, OPTIONS), "rigid-body")
    task, part = fit_first_part(simulate_resting_joint(), "rigid-body", sibling=arm_of_sibling(unit))
    whole = refit(part, task)
    assert whole.arm.mode == "calibrate"
    assert (nmse(whole, simulate_unseen()) <= nmse(part, simulate_unseen()) + 1e-3).all()


@pytest.mark.slow
def test_refit_follows_an_online_model():
    task, part = fit_first_part(simulate_arm(), "rigid-body")
    online = OnlineModel.start(part).learn(as_rows(simulate_arm(seed=6), 0.0)).model()
    assert (nmse(refit(online, task), simulate_arm(seed=8)) < 0.05).all()


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["rigid-body", "lip-chain"])
def test_refit_can_be_cancelled(estimator):
    task, part = fit_first_part(simulate_arm(), estimator)
    with pytest.raises(FitCancelledError):
        refit(part, replace(task, cancelled=lambda: True))

"""Tests of the arm of a simulator that is nearest to a model: its bounds, its optimum, and its error."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import nnls

from lipcore import TorqueModel, load
from lipcore.export.fitted_arm import MAX_DENSITY, fit_arm
from lipcore.export.origin import draw_states
from lipcore.export.simulated_arm import SimulatedArm, inertia_at_centre
from lipcore.kernels.drive.terms import SIGN_WIDTH
from lipcore.model.parameters import report
from lipcore.model.plausible import is_plausible, nearest_plausible
from tests.lipcore.arms import random_bodies
from tests.lipcore.export.models import PANDA, train_arm, with_drive


def arm_of(model: TorqueModel) -> SimulatedArm:
    found = report(model.posterior, model.estimator, model.joint_names)
    return SimulatedArm.of_parameters(found, model.joint_names, model.training_range)


def errors_of(model: TorqueModel, arm: SimulatedArm) -> np.ndarray:
    """Return the root mean square of the torque error at states that the fit has not seen, (n,), without offset."""
    motions = draw_states(model, 2000)[1000:]
    q, dq, ddq = motions.swapaxes(0, 1)
    torque = arm.bodies_torque(motions) + arm.friction_torque(dq, np.tanh(dq / SIGN_WIDTH))
    offset = np.zeros(model.n_joints)
    offset[arm.order] = arm.joints.offset
    return np.sqrt(np.square(model.predict(q, dq, ddq).tau - offset - torque).mean(axis=0))


def assert_possible(arm: SimulatedArm) -> None:
    for body in arm.bodies:
        assert is_plausible(body)
        _, inertia = inertia_at_centre(body)
        ball = np.sqrt(np.trace(inertia) * 5 / 6 / body[0])  # radius of a ball with these moments in all
        assert body[0] <= 1.2 * MAX_DENSITY * 4 / 3 * np.pi * ball**3
    assert min(getattr(arm.joints, name).min() for name in ("rotor", "viscous", "coulomb")) >= 0


def test_nonnegative_weights_are_those_of_nonnegative_least_squares() -> None:
    """Beside bodies far from their bounds, which do not change."""
    bodies, rng = random_bodies(2, 3), np.random.default_rng(0)
    design, target = rng.normal(size=(30, 6)), rng.normal(size=30)
    expected, _ = nnls(design, target)
    assert 0 < (expected == 0).sum() < 6
    metric = np.zeros((26, 26))
    metric[:20, :20], metric[20:, 20:] = 1e6 * np.eye(20), design.T @ design
    mean = np.concatenate([bodies.reshape(-1), np.linalg.lstsq(design, target)[0]])
    found = nearest_plausible(mean, np.ones(26), metric, 2, bodies, np.arange(20, 26), 1e-10)
    np.testing.assert_allclose(found[20:], expected, atol=1e-5)
    np.testing.assert_allclose(found[:20], mean[:20], atol=1e-5)


def test_friction_replaces_terms_that_a_simulator_lacks() -> None:
    model = with_drive(train_arm("RRR", 50), "stribeck", "load", "play")
    arm = arm_of(model)
    fitted = fit_arm(model, arm)
    assert_possible(fitted)
    before, after = errors_of(model, arm), errors_of(model, fitted)
    assert (after < before).all()
    # no other friction is better by more than a hundredth
    for name in ("viscous", "coulomb"):
        for factor in (0.8, 1.25):
            other = replace(fitted, joints=replace(fitted.joints, **{name: factor * getattr(fitted.joints, name)}))
            assert (errors_of(model, other) > 0.99 * after).all()


def test_bodies_replace_negative_rotors() -> None:
    model = load(PANDA)
    arm = arm_of(model)
    worse = replace(arm, joints=replace(arm.joints, rotor=np.full(7, -0.1), viscous=np.full(7, -1.0)))
    fitted = fit_arm(model, worse)
    assert_possible(fitted)
    q, dq, ddq = draw_states(model, 1000).swapaxes(0, 1)
    assert (errors_of(model, fitted) < 0.01 * model.predict(q, dq, ddq).tau.std(axis=0)).all()


def test_model_without_rigid_bodies_is_refused() -> None:
    model = load(PANDA)
    terms = {name: term for name, term in model.estimator.terms.items() if name != "rigid_body"}
    bare = replace(model, estimator=replace(model.estimator, name="lip", terms=terms))
    with pytest.raises(ValueError, match="has no rigid bodies"):
        fit_arm(bare, arm_of(model))

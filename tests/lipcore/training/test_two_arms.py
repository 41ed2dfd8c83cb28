"""Tests of one model for two arms on one base: as good as two models, and without influence of one on the other."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from lipcore import FitOptions, TorqueModel, load, save, train
from lipcore.arm.learning import learn
from lipcore.estimators.task import Task
from lipcore.export.simulated_arm import SimulatedArm
from lipcore.export.urdf_writer import urdf_text
from lipcore.model.parameters import report
from lipcore.model.payload import Carrier, NoArmError
from lipcore.model.wrench import NoWrenchError, external_wrench, has_wrench
from lipcore.online.learner import OnlineModel
from lipcore.robots.urdf import RigidBody
from lipcore.training.correction import correct
from lipcore.training.fit import fit_estimator
from tests.choosing import slow
from tests.lipcore.arm_oracles import as_rows, correction_before, nmse_per_joint
from tests.lipcore.two_arms import NAMES, SIDES, TYPES, URDF, record_two_arms, two_arms

OPTIONS = FitOptions(posterior_samples=200, search_seconds=2.0)
"""All samples are used, so that one model and two models learn from the same ones."""


def trained(estimator: str = "rigid-body", **options: str) -> TorqueModel:
    return train(record_two_arms(1), TYPES, estimator, replace(OPTIONS, **options), robot=two_arms())


def assert_arms_are_independent(model: TorqueModel) -> None:
    """Assert that torque, deviation and covariance of an arm do not change at all with the motion of the other.

    The other arm moves much faster than in training, which adds variance to its own joints (`posterior.misfit`).
    """
    q, dq, ddq = 0.5 * np.random.default_rng(0).uniform(-1, 1, (3, 20, 4))
    before = model.predict(q, dq, ddq, covariance=True)
    for arm in (0, 1):
        own, other = np.flatnonzero(arm == SIDES), np.flatnonzero(arm != SIDES)
        moved = [
            np.where(arm == SIDES, each, change) for each, change in ((q, q + 0.3), (dq, 20 * dq), (ddq, 20 * ddq))
        ]
        after = model.predict(*moved, covariance=True)
        assert (np.abs(after.tau - before.tau)[:, other] > 1e-3).any()
        np.testing.assert_array_equal(after.tau[:, own], before.tau[:, own])
        np.testing.assert_array_equal(after.tau_std[:, own], before.tau_std[:, own])
        assert (after.tau_std[:, other] > before.tau_std[:, other]).any()
        assert after.covariance is not None
        np.testing.assert_allclose(after.covariance[:, own[:, None], other], 0.0, atol=1e-14)
        np.testing.assert_allclose(model.torque(*moved)[:, own], before.mean[:, own], rtol=0, atol=1e-11)


@pytest.mark.parametrize("geometry", ["calibrate", slow("fixed")])
def test_one_model_is_as_good_as_two(geometry: str) -> None:
    model, unseen = trained(geometry=geometry), record_two_arms(2)
    assert (model.arms, model.fit["geometry"]) == (2, geometry)
    assert_arms_are_independent(model)
    together, alone = nmse_per_joint(model, unseen), np.empty(4)
    for arm in (0, 1):
        joints = np.flatnonzero(arm == SIDES)
        robot = RigidBody.from_urdf(URDF, tuple(NAMES[joint] for joint in joints), TYPES[:2])
        samples = record_two_arms(1).joints(joints)
        one = train(samples, TYPES[:2], "rigid-body", replace(OPTIONS, geometry=geometry), robot=robot)
        alone[joints] = nmse_per_joint(one, unseen.joints(joints))
    np.testing.assert_allclose(together, alone, rtol=1e-6)


@pytest.mark.slow
def test_arms_are_learnt_without_a_urdf() -> None:
    chain = np.argsort(SIDES, kind="stable")
    samples, unseen = record_two_arms(1).joints(chain), record_two_arms(2).joints(chain)
    model = train(samples, TYPES, "rigid-body", replace(OPTIONS, arms="2,2"))
    assert model.arm is not None
    assert (model.arm.geometry.roots, model.fit["geometry"]) == ((0, 2), "learn")
    assert (nmse_per_joint(model, unseen) < 1e-3).all()


@pytest.mark.slow
def test_another_unit_is_learnt_from_a_model_of_two_arms() -> None:
    base, samples, unseen = trained(), record_two_arms(4, 40), record_two_arms(2)
    unit = train(samples, TYPES, "rigid-body", OPTIONS, base=base)
    assert unit.arms == 2
    assert (nmse_per_joint(unit, unseen) < 1e-2).all()


@pytest.mark.slow
def test_auto_does_not_try_the_serial_chain() -> None:
    model = trained("auto")
    assert model.selection is not None
    assert {row["estimator"] for row in model.selection["table"]} <= {"rigid-body", "rigid-body+local"}
    assert_arms_are_independent(model)


@pytest.mark.slow
def test_correction_and_learning_leave_the_other_arm_alone() -> None:
    samples = record_two_arms(1)
    bent = replace(samples, tau=samples.tau + 0.1 * np.sin(9 * samples.q))
    task = Task(bent, TYPES, OPTIONS, robot=two_arms())
    before = correction_before(bent, (0, 1))
    model = fit_estimator(task, "rigid-body+local", learn(task), correct=partial(correct, before=before))
    assert_arms_are_independent(model)
    assert_arms_are_independent(OnlineModel.start(model).learn(as_rows(record_two_arms(3))).model())


def test_files_keep_the_arms(tmp_path: Path) -> None:
    model = trained()
    manifest = save(model, tmp_path / "model")
    again, query = load(tmp_path / "model"), np.random.default_rng(0).uniform(-1, 1, (3, 20, 4))
    for each in (query, 20 * query):  # the misfit of motion faster than in training is one for each arm
        np.testing.assert_array_equal(again.predict(*each).tau, model.predict(*each).tau)
        np.testing.assert_array_equal(again.predict(*each).tau_std, model.predict(*each).tau_std)
    roots = [joint.get("root", False) for joint in manifest["parameters"]["geometry"]["joints"]]
    assert roots == [False, False, True, False]
    parameters = report(model.posterior, model.estimator, model.joint_names)
    urdf = urdf_text(SimulatedArm.of_parameters(parameters, model.joint_names, model.training_range))
    assert RigidBody.from_urdf(urdf, NAMES, TYPES).roots == (0, 2)


def test_payloads_and_wrenches_are_for_one_arm() -> None:
    model = trained()
    with pytest.raises(NoArmError, match="the model has 2 arms, but payloads are supported for one arm: train a model"):
        Carrier(model)
    assert not has_wrench(model)
    with pytest.raises(NoWrenchError, match="the model has 2 arms; a wrench needs a model of one arm"):
        external_wrench(model, np.zeros((3, 4)), np.zeros(4))

"""What the client shows of an arm that was learnt."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from service.client.results import arm as results
from service.client.results.arm import Arm, read_arm
from service.models.schema import Version
from tests.lipcore.arms import parameters_of
from tests.service.models.arms import JOINTS, panda

REVERSED = JOINTS[::-1]


def version(parameters) -> Version:
    n = len(JOINTS)
    return Version(
        model="m",
        version=1,
        created_at="2026-01-01T00:00:00+00:00",
        job=None,
        estimator="rigid-body",
        joint_names=list(REVERSED),
        joint_types=["revolute"] * n,
        torque_convention="gravity_included",
        noise_std=[0.1] * n,
        training_range={},
        options={},
        fit={},
        calibration={},
        lineage={},
        parameters=parameters,
    )


@pytest.fixture(scope="module")
def robot():
    from lipcore.robots.urdf import RigidBody

    return RigidBody.from_profile("panda", REVERSED, panda().joint_types)


@pytest.fixture
def arm(robot) -> Arm:
    return read_arm(version(parameters_of(robot)))


def test_it_is_pinocchios(robot, arm):
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, np.zeros(7))
    joints = list(data.oMi)[1:]
    assert arm.joint_names == JOINTS
    np.testing.assert_allclose(arm.frames.place, [each.translation for each in joints], atol=1e-12)
    np.testing.assert_allclose(arm.frames.axis, [each.rotation[:, 2] for each in joints], atol=1e-12)
    bodies = list(robot.model.inertias)[1:]
    np.testing.assert_allclose(arm.mass, [each.mass for each in bodies])
    np.testing.assert_allclose(arm.centre, [each.lever for each in bodies], atol=1e-12)


def test_deviations_of_centres_are_those_of_draws(robot, arm):
    """First moment and mass are drawn apart, as the manifest holds no covariance of theirs."""
    body = parameters_of(robot)["inertia"]["bodies"][-1]  # of the first joint
    mean, std = body["plausible"], body["std"]
    rng = np.random.default_rng(0)
    draws = rng.normal(mean["first_moment"], std["first_moment"], (100_000, 3))
    draws /= rng.normal(mean["mass"], std["mass"], (100_000, 1))
    np.testing.assert_allclose(arm.centre_std[0], draws.std(axis=0), rtol=0.03)


def test_text_and_html_show_every_joint_and_what_torque_does_not_tell(arm):
    text = str(arm)
    for part in (
        *JOINTS,
        "mass, first moment",
        "shift 2",
        "mirror image",
        "0.1 ± 0.01",
        "0.057, 0.11",
        "torque off N·m",
    ):
        assert part in text, part
    assert "<td>mass, first moment</td>" in arm._repr_html_()
    assert arm.as_dict()["frames"]["mode"] == "learn"


def test_text_of_a_version_begins_with_its_warnings(robot):
    text = str(results.Version(**version(parameters_of(robot)).model_dump() | {"warnings": ["Two arms explain it."]}))
    assert text.splitlines()[1] == "careful: Two arms explain it."


def test_versions_of_earlier_releases(robot):
    report = parameters_of(robot)
    del report["inertia"]["plausible_deviation"]
    old = read_arm(version({name: report[name] for name in ("friction", "inertia")}))
    assert old.frames is None
    assert old.joint_names == REVERSED
    assert "rotor" not in str(old)
    assert "torque off N·m" not in str(old)
    assert read_arm(version({"friction": report["friction"]})) is None
    assert read_arm(version(None)) is None


def test_friction_of_slow_joints_is_shown_where_it_was_learnt(robot, arm):
    parameters = parameters_of(robot)
    parameters["friction"]["stribeck"] = {"mean": [float(k) for k in range(7)], "std": [0.01] * 7}
    shown = read_arm(version(parameters))
    np.testing.assert_allclose(shown.friction["stribeck"][0], range(6, -1, -1))
    assert list(shown.tables()["friction"])[-1] == "at low speed N·m"
    assert "stribeck" not in arm.friction
    assert "low speed" not in str(arm)

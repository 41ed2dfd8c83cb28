"""Tests of a known robot's mounting: the position and tilt of its base, and the zeros of its joints."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore import FitOptions, Samples, TorqueModel, load, save, train
from lipcore.arm import mounting
from lipcore.arm.mounting import POSITIONS, UPRIGHT, turn_joints
from lipcore.data.motion import Array
from lipcore.kernels.geometry import rotation_of, rotation_to_axis
from lipcore.model.parameters import report
from lipcore.model.warnings import warnings
from lipcore.robots.library import ROBOTS, load_robot
from lipcore.robots.simulation import Simulation, simulate
from lipcore.robots.urdf import RigidBody
from tests.choosing import slow
from tests.lipcore.arm_oracles import as_robot, nmse_per_joint
from tests.lipcore.arms import random_bodies, random_geometry

TILTED, BODIES = random_geometry("RRPR", 12), random_bodies(4, 12)
UPWARD = rotation_to_axis(np.array([0.0, 0.0, 1.0])) @ rotation_to_axis(TILTED.axis[0]).T
GEOMETRY = replace(
    TILTED, rotation=np.concatenate([UPWARD[None], TILTED.rotation[1:]]), gravity=np.array([0.0, 0.0, -9.81])
)
"""With a first axis that is upright."""
ROBOT = as_robot(GEOMETRY, BODIES)
NAMES = ROBOT.joint_names
URDF = RigidBody("arm", "", NAMES, ROBOT.joint_types, NAMES, "name", ROBOT.model)
WALL = "on a wall, -x up"


def record(turn: Array, zeros: Array | None = None, seed: int = 1) -> Samples:
    """Simulate the robot with its base turned by a rotation vector, rad, and with other zeros of its joints."""
    turned = ROBOT.model.copy()
    turned.gravity.linear = rotation_of(turn).T @ GEOMETRY.gravity
    stream = Simulation(400, 20.0, n_sinusoids=30, speed=6.0, noise=0.02, viscous=0.3)
    samples = simulate(replace(ROBOT, model=turned), stream, seed)
    return samples if zeros is None else replace(samples, q=samples.q - zeros)


def train_with_urdf(samples: Samples) -> TorqueModel:
    return train(samples, ROBOT.joint_types, "rigid-body", robot=URDF)


def texts(model: TorqueModel) -> str:
    return " ".join(warnings(model, report(model.posterior, model.estimator, model.joint_names)))


def test_robot_as_in_its_urdf_has_no_other_mounting() -> None:
    model = train_with_urdf(record(np.zeros(3)))
    assert "mounting" not in model.fit
    assert float(model.fit["base_tilt"]) < 0.5
    assert float(model.fit["zero_nats"]) == 0.0
    assert texts(model) == ""


@pytest.mark.parametrize("position", [slow("upside down"), WALL])
def test_other_position_of_the_base_is_found(position: str) -> None:
    turn = np.array(POSITIONS[position])
    model = train_with_urdf(record(turn))
    assert model.fit["mounting"] == position
    assert f"shows the robot {position}, not as in the URDF" in texts(model)
    assert (nmse_per_joint(model, record(turn, seed=2)) < 0.01).all()


def test_tilt_of_the_base_is_found() -> None:
    model = train_with_urdf(record(np.array([np.radians(4.0), 0.0, 0.0])))
    assert float(model.fit["base_tilt"]) == pytest.approx(4.0, abs=0.3)
    assert "The base is tilted by" in texts(model)


def test_zeros_of_joints_are_found() -> None:
    zeros = np.array([0.0, np.radians(4.0), 0.0, 0.0])
    model = train_with_urdf(record(np.zeros(3), zeros))
    found, std = float(model.fit["zero_2"]), float(model.fit["std_of_zero_2"])
    assert abs(found - 4.0) < 3 * std
    assert found > 2.0
    assert "The zero position differs from the URDF: joint2 by" in texts(model)
    assert (nmse_per_joint(model, record(np.zeros(3), zeros, seed=2)) < 0.01).all()


def test_turned_joints_move_like_measured_positions() -> None:
    """A geometry with other zeros has the frames that the URDF's has at positions plus these zeros."""
    zeros, q = np.array([0.1, -0.2, 0.03, 0.4]), np.array([0.5, 0.2, -0.1, 1.0])
    for one, two in zip(turn_joints(GEOMETRY, zeros).placements(q), GEOMETRY.placements(q + zeros), strict=True):
        np.testing.assert_allclose(one, two, atol=1e-12)


def test_positions_of_the_base_point_the_named_axis_up() -> None:
    up = {"+x": 0, "-x": 0, "+y": 1, "-y": 1}
    for name, vector in POSITIONS.items():
        turned = rotation_of(np.array(vector))
        if name == UPRIGHT:
            np.testing.assert_allclose(turned, np.eye(3))
        elif name == "upside down":
            np.testing.assert_allclose(turned[:, 2], [0, 0, -1], atol=1e-12)
        else:
            sign, axis = name.removeprefix("on a wall, ")[0], name.removeprefix("on a wall, ")[:2]
            np.testing.assert_allclose(turned[:, up[axis]], [0, 0, 1.0 if sign == "+" else -1.0], atol=1e-12)
    assert mounting.mount(GEOMETRY, UPRIGHT).constants == pytest.approx(GEOMETRY.constants)


def test_fit_names_joints_that_the_data_lack(tmp_path) -> None:
    robot = RigidBody.from_profile("panda", ROBOTS["panda"].free, ("revolute",) * 7)
    samples = simulate(load_robot("panda"), Simulation(200, 20.0, noise=0.02), 0)
    model = train(samples, robot.joint_types, "rigid-body", FitOptions(geometry="fixed"), robot=robot)
    save(model, tmp_path / "model")
    loaded = load(tmp_path / "model")
    assert loaded.fit["fixed_joints"] == "panda_finger_joint1, panda_finger_joint2"
    assert loaded.robot is not None
    assert loaded.robot.fixed_joints == robot.fixed_joints

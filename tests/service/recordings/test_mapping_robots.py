"""Robots as they name their joints, and the two real recordings, from the file to columns in SI units."""

from __future__ import annotations

import sqlite3

import numpy as np
import pytest

from lipcore.profiles import profile
from service.datasets.formats.opening import open_table
from service.datasets.mapping.reading import read
from service.foundation.errors import InvalidDataError
from service.foundation.settings import Settings
from service.storage.storage import Disk
from tests.lipcore.test_real_data import PANDA, SCHUNK
from tests.service.recordings.mapping_tables import options
from tests.service.recordings.test_mapping_names import RTDE, mapped, read_as

UR_ALPHABETICAL = ("elbow", "shoulder_lift", "shoulder_pan", "wrist_1", "wrist_2", "wrist_3")
"""As the joint state broadcaster of ROS lists them."""
UR = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")


def fields(joints, *more):
    return ["t", *(f"{joint}/{what}" for joint in joints for what in ("position", "velocity", "effort")), *more]


@pytest.mark.parametrize("prefix", ["", "ur5e_", "left_"])
def test_joints_of_a_universal_robot_are_put_in_order(prefix):
    robot = profile("ur5e")
    names = fields([f"{prefix}{joint}_joint" for joint in UR_ALPHABETICAL], "gripper/position")
    found = mapped(names, options(effort="measured"), robot)
    assert found.joints == robot.joint_names
    assert read_as(found)["tau"] == [f"{prefix}{joint}_joint/effort" for joint in UR]
    assert list(found.dropped) == ["gripper"]


def test_what_a_universal_robot_calls_effort_is_current():
    names = fields([f"{joint}_joint" for joint in UR])
    with pytest.raises(InvalidDataError, match="torque_constants is missing, expected 6"):
        mapped(names, robot=profile("ur5e"))
    assert mapped(RTDE, options(torque_constants=(2.0,) * 6), profile("ur5e")).joints == profile("ur5e").joint_names


@pytest.mark.parametrize("names", ["fer_joint#", "panda_joint#", "joint#", "left_panda_joint#"])
def test_a_panda_is_known_by_all_its_names(names):
    joints = [names.replace("#", str(joint)) for joint in (3, 1, 2, 4, 5, 6, 7)]
    found = mapped(fields(joints), robot=profile("panda"))
    assert found.joints == profile("panda").joint_names
    assert read_as(found)["q"] == [f"{names.replace('#', str(joint))}/position" for joint in range(1, 8)]
    assert found.torque.effort == "measured"


def test_a_locked_joint_of_a_panda_may_be_left_out():
    found = mapped(
        fields([f"fer_joint{joint}" for joint in range(1, 8)]), options(drop_joints=("fer_joint3",)), profile("panda")
    )
    assert found.joints == tuple(f"panda_joint{joint}" for joint in (1, 2, 4, 5, 6, 7))


def from_file(tmp_path, path, kind, robot=None):
    limits = Settings(home=tmp_path)
    with open_table(path, kind, options().read, limits) as given:
        return read(given, tmp_path, options(), robot, limits, Disk(limits))


@pytest.mark.skipif(not PANDA.exists(), reason=f"{PANDA} is not there")
def test_the_recording_of_a_real_panda(tmp_path):
    rosbags = pytest.importorskip("rosbags.typesys")
    store = rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)
    with sqlite3.connect(f"file:{PANDA}?mode=ro", uri=True) as database:
        rows = database.execute("SELECT data FROM messages ORDER BY timestamp").fetchall()
    database.close()
    messages = [store.deserialize_cdr(data, "sensor_msgs/msg/JointState") for (data,) in rows]
    found = from_file(tmp_path, PANDA, "rosbag2", profile("panda"))
    assert found.staged.joint_names == profile("panda").joint_names
    assert (found.facts["effort"], found.torque_convention) == ("measured", "gravity_included")
    for quantity, field in (("q", "position"), ("dq", "velocity"), ("tau", "effort")):
        expected = np.array([getattr(message, field) for message in messages])
        np.testing.assert_array_equal(found.staged.table(quantity), expected)


@pytest.mark.skipif(not SCHUNK.exists(), reason=f"{SCHUNK} is not there")
def test_the_episodes_of_a_real_schunk(tmp_path):
    found = from_file(tmp_path, SCHUNK, "npz")
    assert found.noted == []
    with np.load(SCHUNK) as file:
        for quantity in ("q", "dq", "tau"):
            np.testing.assert_array_equal(found.staged.table(quantity), file[quantity])
        np.testing.assert_array_equal(found.staged.read("episode"), file["episode"])

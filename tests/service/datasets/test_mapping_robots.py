"""Joint names of real robots, and two real recordings, from the file to columns in SI units."""

import sqlite3

import numpy as np
import pytest

from lipcore.profiles import profile
from service.datasets.formats.opening import open_table
from service.datasets.mapping.reading import read
from service.foundation.settings import Settings
from service.storage.disk import Disk
from tests.service.datasets.mapping_tables import options
from tests.service.datasets.test_mapping_names import mapped
from tests.service.training.test_real_data import PANDA, SCHUNK


def test_panda_is_recognised_by_the_names_of_its_driver():
    names = [f"fer_joint{joint}/{what}" for joint in (3, 1, 2, 4, 5, 6, 7) for what in ("position", "effort")]
    result = mapped(names, robot=profile("panda"))
    assert result.joints == profile("panda").joint_names
    assert [each.name for each in result.quantities["q"]] == [f"fer_joint{joint}/position" for joint in range(1, 8)]


def from_file(tmp_path, path, kind, robot=None):
    limits = Settings(home=tmp_path)
    with open_table(path, kind, options().read, limits) as given:
        return read(given, tmp_path, options(), robot, limits, Disk(limits))


@pytest.mark.skipif(not PANDA.exists(), reason=f"{PANDA} is not there")
def test_recording_of_a_real_panda_is_mapped(tmp_path):
    rosbags = pytest.importorskip("rosbags.typesys")
    store = rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)
    with sqlite3.connect(f"file:{PANDA}?mode=ro", uri=True) as database:
        rows = database.execute("SELECT data FROM messages ORDER BY timestamp").fetchall()
    database.close()
    messages = [store.deserialize_cdr(data, "sensor_msgs/msg/JointState") for (data,) in rows]
    result = from_file(tmp_path, PANDA, "rosbag2", profile("panda"))
    assert result.staged.joint_names == profile("panda").joint_names
    assert (result.facts["effort"], result.torque_convention) == ("measured", "gravity_included")
    for quantity, field in (("q", "position"), ("dq", "velocity"), ("tau", "effort")):
        expected = np.array([getattr(message, field) for message in messages])
        np.testing.assert_array_equal(result.staged.table(quantity), expected)


@pytest.mark.skipif(not SCHUNK.exists(), reason=f"{SCHUNK} is not there")
def test_episodes_of_a_real_schunk_are_mapped(tmp_path):
    result = from_file(tmp_path, SCHUNK, "npz")
    assert result.noted == []
    with np.load(SCHUNK) as file:
        for quantity in ("q", "dq", "tau"):
            np.testing.assert_array_equal(result.staged.table(quantity), file[quantity])
        np.testing.assert_array_equal(result.staged.read("episode"), file["episode"])

"""The choice of the topic, and the message types: joint states, Franka states and controller states."""

from typing import Any

import numpy as np
import pytest

from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError, InvalidRequestError
from tests.service.datasets import bag_writers as bags
from tests.service.datasets.bag_writers import ROS1, ROS2, START, altered, read, states, table_of, typesys

JOINTS = tuple(f"fr3_joint{joint}" for joint in range(1, 8))
FRANKA_STATE = """std_msgs/Header header
float64[6] cartesian_collision
float64[7] q
float64[7] q_d
float64[7] dq
float64[7] tau_J
float64[7] tau_ext_hat_filtered
uint8 ROBOT_MODE_OTHER=0
string CHOICE=a # b
uint8 robot_mode
franka_msgs/Errors current_errors
================================================================================
MSG: franka_msgs/Errors
bool joint_reflex
"""
ROS2_FRANKA_STATE = FRANKA_STATE.replace("tau_J", "tau_j")
FRANKA_ROBOT_STATE = """std_msgs/Header header
CollisionIndicators collision_indicators
sensor_msgs/JointState measured_joint_state
sensor_msgs/JointState desired_joint_state
float64[7] ddq_d
uint8 robot_mode
================================================================================
MSG: franka_msgs/CollisionIndicators
geometry_msgs/Vector3 is_cartesian_linear_collision
geometry_msgs/Vector3 is_cartesian_angular_collision
geometry_msgs/Vector3 is_cartesian_linear_contact
geometry_msgs/Vector3 is_cartesian_angular_contact
float64[7] is_joint_collision
float64[7] is_joint_contact
"""
CONTROLLER = """std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint desired
trajectory_msgs/JointTrajectoryPoint actual
trajectory_msgs/JointTrajectoryPoint error
"""


def store_with(name: str, text: str, base: Any) -> Any:
    """Return a type store with one more type."""
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if base is ROS1 else typesys.Stores.ROS2_HUMBLE)
    store.register(typesys.get_types_from_msg(text, name))
    return store


def write(path, name: str, messages: list[Any], store: Any, ros1: bool = False):
    """Write messages on the topic /state at 1 kHz."""
    timed = [("/state", START + number * 10**6, each) for number, each in enumerate(messages)]
    if ros1:
        bags.write_messages(bags.rosbag1.Writer(path), store, name, timed)
        return path
    bags.write_messages(bags.rosbag2.Writer(path.with_suffix(""), version=9), store, name, timed)
    return bags.bare(path.with_suffix(""), path)


def filled(store: Any, name: str, given: dict[str, Any]) -> Any:
    """Return a message, with messages within as dictionaries; fields that are not given are zero."""
    values = {}
    for field, (node, what) in store.fielddefs[name][1]:
        if node == typesys.store.Nodetype.NAME:
            values[field] = filled(store, what, given.get(field, {}))
        elif field in given:
            values[field] = given[field]
        elif node == typesys.store.Nodetype.BASE:
            values[field] = {"string": "", "bool": False}.get(what[0], 0)
        else:
            size = what[1] if node == typesys.store.Nodetype.ARRAY else 0
            values[field] = [] if what[0][1][0] == "string" else np.zeros(size)
    return store.types[name](**values)


def forget_definitions(path):
    """Remove the message definitions, which ROS 2 Humble does not record."""
    older = "UPDATE schema SET schema_version = 3; ALTER TABLE topics DROP COLUMN type_description_hash"
    bags.run_script(path, f"DROP TABLE message_definitions; {older}")


def franka_state(torque):
    """Return the fields of a Franka state, whose torque differs in name."""
    return lambda q, dq, tau: {"q": q, "dq": dq, "q_d": q + 9, torque: tau}


def robot_state(*numbers):
    """Return the fields of a Franka robot state."""
    sets = {"measured_joint_state": numbers, "desired_joint_state": np.array(numbers) + 5}
    fields = {key: dict(zip(bags.QUANTITIES, each, strict=True)) for key, each in sets.items()}
    return {key: {"name": list(JOINTS), **each} for key, each in fields.items()}


def controller_state(*numbers):
    """Return the fields of the state of a controller."""
    points = {"desired": np.array(numbers) + 3, "actual": numbers}
    fields = {key: dict(zip(("positions", "velocities", "effort"), each, strict=True)) for key, each in points.items()}
    return {"joint_names": list(JOINTS), **fields}


NUMBERED = tuple(f"joint{joint}" for joint in range(1, 8))
ROBOT_STATE = ("franka_msgs/msg/FrankaRobotState", FRANKA_ROBOT_STATE, ROS2, robot_state)
CONTROLLER_STATE = ("control_msgs/msg/JointTrajectoryControllerState", CONTROLLER, ROS1, controller_state)


@pytest.mark.parametrize(
    ("name", "text", "base", "fields", "with_definition", "joints"),
    [
        ("franka_msgs/msg/FrankaState", FRANKA_STATE, ROS1, franka_state("tau_J"), True, NUMBERED),
        ("franka_msgs/msg/FrankaState", ROS2_FRANKA_STATE, ROS2, franka_state("tau_j"), True, NUMBERED),
        (*ROBOT_STATE, True, JOINTS),
        (*ROBOT_STATE, False, JOINTS),  # as ROS 2 Humble records it: the known start of the message is read
        (*CONTROLLER_STATE, True, JOINTS),
    ],
    ids=["Franka, ROS 1", "Franka, ROS 2", "Franka robot", "Franka robot without definition", "controller"],
)
def test_state_of_another_type_is_read(tmp_path, name, text, base, fields, with_definition, joints):
    store, numbers = store_with(name, text, base), np.random.default_rng(0).normal(size=(40, 3, 7))
    messages = []
    for number, each in enumerate(numbers):
        stamp = dict(zip(("sec", "nanosec"), divmod(START + number * 10**6, 10**9), strict=True))
        messages.append(filled(store, name, {"header": {"stamp": stamp, "frame_id": "base"}, **fields(*each)}))
    path = write(tmp_path / "upload.x", name, messages, store, base is ROS1)
    if not with_definition:
        forget_definitions(path)
    for names in (None, JOINTS):
        result = read(path, ReadOptions(joint_names=names))
        np.testing.assert_array_equal(result.rows[:, 1:], numbers.reshape(40, -1))
        np.testing.assert_array_equal(result["t"], np.arange(40) / 1000)
        assert result.joint_names == (names or joints)
        unit = result.units.get(result.names[-1])
        assert unit == ("N·m" if "franka" in name else None)


@pytest.mark.parametrize("write", [bags.write_mcap, bags.write_rosbag1, bags.write_db3])
def test_several_topics_need_a_choice(tmp_path, write):
    written = altered(states(30), slice(None, None, 3), topic="/other_arm")
    path = write(tmp_path / "upload.x", written)
    with pytest.raises(InvalidDataError, match="Set `topic`, because the bag has several") as error:
        read(path)
    assert "/other_arm (sensor_msgs/JointState, 10 messages)" in str(error.value)
    assert "/joint_states (sensor_msgs/JointState, 20 messages)" in str(error.value)
    with pytest.raises(InvalidRequestError, match=r"topic is /third, expected one of .*/other_arm"):
        read(path, ReadOptions(topic="/third"))
    result = read(path, ReadOptions(topic="/joint_states"))
    np.testing.assert_array_equal(result.rows, table_of(each for each in written if each.topic == "/joint_states"))


def test_bag_without_joint_states_is_rejected_with_its_topics(tmp_path):
    name = "std_msgs/msg/String"
    path = write(tmp_path / "upload.x", name, [ROS2.types[name](data="hello")] * 3, ROS2)
    with pytest.raises(
        InvalidDataError, match=r"/state \(std_msgs/String, 3 messages\), expected a topic with a position and a torque"
    ):
        read(path)
    with pytest.raises(InvalidRequestError, match=r"topic is /state of type std_msgs/String \(cdr\)"):
        read(path, ReadOptions(topic="/state"))


def test_type_without_its_definition_is_rejected(tmp_path):
    name = "franka_msgs/msg/FrankaState"
    store = store_with(name, ROS2_FRANKA_STATE, ROS2)
    path = write(tmp_path / "upload.x", name, [filled(store, name, {})], store)
    forget_definitions(path)
    with pytest.raises(InvalidDataError, match="of type franka_msgs/FrankaState, whose definition is not in the bag"):
        read(path)

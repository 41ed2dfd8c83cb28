"""Which topic is read, and the types that are: joint states, Franka's states, controllers' states."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError, InvalidRequestError
from tests.service.recordings.bag_writers import (
    ROS1,
    ROS2,
    START,
    bare,
    message,
    read,
    rosbag1,
    rosbag2,
    states,
    table_of,
    typesys,
    write_mcap,
    write_rosbag1,
    write_rosbag2,
)

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
    """A type store that knows one type more."""
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if base is ROS1 else typesys.Stores.ROS2_HUMBLE)
    store.register(typesys.get_types_from_msg(text, name))
    return store


def write(path, name: str, messages: list[Any], store: Any, ros1: bool):
    """Messages on the topic /state, 1 kHz."""
    if ros1:
        with rosbag1.Writer(path) as writer:
            connection = writer.add_connection("/state", name, typestore=store)
            for number, each in enumerate(messages):
                writer.write(connection, START + number * 10**6, store.serialize_ros1(each, name))
        return path
    with rosbag2.Writer(path.with_suffix(""), version=9) as writer:
        connection = writer.add_connection("/state", name, typestore=store)
        for number, each in enumerate(messages):
            writer.write(connection, START + number * 10**6, store.serialize_cdr(each, name))
    return bare(path.with_suffix(""), path)


def filled(store: Any, name: str, **given: Any) -> Any:
    """A message whose fields not given are zeros."""
    values = {}
    for field, (node, what) in store.fielddefs[name][1]:
        if field in given:
            values[field] = given[field]
        elif node == typesys.store.Nodetype.NAME:
            values[field] = filled(store, what)
        elif node == typesys.store.Nodetype.BASE:
            values[field] = {"string": "", "bool": False}.get(what[0], 0)
        else:
            size = what[1] if node == typesys.store.Nodetype.ARRAY else 0
            values[field] = [] if what[0][1][0] == "string" else np.zeros(size)
    return store.types[name](**values)


def seven(seed: int, count: int = 40) -> np.ndarray:
    """Positions, velocities and efforts of seven joints."""
    return np.random.default_rng(seed).normal(size=(count, 3, 7))


def stamp(store: Any, number: int) -> Any:
    """A header, number ms after the start."""
    time = START + number * 10**6
    return filled(
        store,
        "std_msgs/msg/Header",
        stamp=store.types["builtin_interfaces/msg/Time"](sec=time // 10**9, nanosec=time % 10**9),
        frame_id="base",
    )


@pytest.mark.parametrize("ros1", [True, False])
def test_franka_state(tmp_path, ros1):
    text = FRANKA_STATE if ros1 else FRANKA_STATE.replace("tau_J", "tau_j")
    name, numbers = "franka_msgs/msg/FrankaState", seven(0)
    store = store_with(name, text, ROS1 if ros1 else ROS2)
    said = [
        filled(store, name, header=stamp(store, number), q=q, dq=dq, q_d=q + 9, **{"tau_J" if ros1 else "tau_j": tau})
        for number, (q, dq, tau) in enumerate(numbers)
    ]
    found = read(write(tmp_path / "upload.x", name, said, store, ros1), "rosbag1" if ros1 else "rosbag2")
    np.testing.assert_array_equal(found.rows[:, 1:], numbers.reshape(40, -1))
    np.testing.assert_array_equal(found.column("t"), np.arange(40) / 1000)
    assert found.joint_names == tuple(f"joint{joint}" for joint in range(1, 8))
    assert found.units["joint3/effort"] == "N·m"
    named = read(tmp_path / "upload.x", "rosbag1" if ros1 else "rosbag2", ReadOptions(joint_names=JOINTS))
    assert named.joint_names == JOINTS


@pytest.mark.parametrize("with_definition", [True, False])
def test_franka_robot_state(tmp_path, with_definition):
    """Without its definition, as ROS 2 Humble records it, the message is read as far as its beginning is known."""
    import sqlite3

    name, numbers = "franka_msgs/msg/FrankaRobotState", seven(1)
    store = store_with(name, FRANKA_ROBOT_STATE, ROS2)

    def state(q, dq, tau):
        kind = store.types["sensor_msgs/msg/JointState"]
        header = filled(store, "std_msgs/msg/Header")
        return kind(header=header, name=list(JOINTS), position=q, velocity=dq, effort=tau)

    said = [
        filled(
            store,
            name,
            header=stamp(store, number),
            measured_joint_state=state(*each),
            desired_joint_state=state(*(each + 5)),
        )
        for number, each in enumerate(numbers)
    ]
    path = write(tmp_path / "upload.x", name, said, store, ros1=False)
    if not with_definition:
        with sqlite3.connect(path) as database:
            database.execute("DROP TABLE message_definitions")
        database.close()
    found = read(path, "rosbag2")
    assert found.joint_names == JOINTS
    np.testing.assert_array_equal(found.rows[:, 1:], numbers.reshape(40, -1))
    np.testing.assert_array_equal(found.column("t"), np.arange(40) / 1000)


def test_state_of_a_controller(tmp_path):
    name, numbers = "control_msgs/msg/JointTrajectoryControllerState", seven(2)
    store = store_with(name, CONTROLLER, ROS1)

    def point(q, dq, tau):
        kind = "trajectory_msgs/msg/JointTrajectoryPoint"
        return filled(store, kind, positions=q, velocities=dq, effort=tau)

    said = [
        filled(
            store,
            name,
            header=stamp(store, number),
            joint_names=list(JOINTS),
            desired=point(*(each + 3)),
            actual=point(*each),
        )
        for number, each in enumerate(numbers)
    ]
    found = read(write(tmp_path / "upload.x", name, said, store, ros1=True), "rosbag1")
    np.testing.assert_array_equal(found.rows[:, 1:], numbers.reshape(40, -1))


def test_several_topics_ask_which(tmp_path):
    said = states(30)
    for each in said[::3]:
        each.topic = "/desired"
    for path, kind in (
        (write_mcap(tmp_path / "a.mcap", said), "mcap"),
        (write_rosbag1(tmp_path / "a.bag", said), "rosbag1"),
        (bare(write_rosbag2(tmp_path / "bag", said), tmp_path / "a.db3"), "rosbag2"),
    ):
        with pytest.raises(InvalidDataError, match="topic is not given") as error:
            read(path, kind)
        assert "/desired (sensor_msgs/JointState, 10 messages)" in str(error.value)
        assert "/joint_states (sensor_msgs/JointState, 20 messages)" in str(error.value)
        with pytest.raises(InvalidRequestError, match=r"topic is /other, expected one of .*/desired"):
            read(path, kind, ReadOptions(topic="/other"))
        found = read(path, kind, ReadOptions(topic="/joint_states"))
        np.testing.assert_array_equal(found.rows, table_of(each for each in said if each.topic == "/joint_states"))


def test_several_publishers_of_one_topic_are_one_recording(tmp_path):
    said = states(20)
    name = "sensor_msgs/msg/JointState"
    with rosbag1.Writer(tmp_path / "a.bag") as writer:
        first = writer.add_connection("/joint_states", name, typestore=ROS1, callerid="/one")
        second = writer.add_connection("/joint_states", name, typestore=ROS1, callerid="/two")
        for number, each in enumerate(said):
            data = ROS1.serialize_ros1(message(ROS1, each), name)
            writer.write((first, second)[number % 2], each.stamp, data)
    np.testing.assert_array_equal(read(tmp_path / "a.bag", "rosbag1").rows, table_of(said))


def test_a_bag_without_joint_states_says_what_it_has(tmp_path):
    name = "std_msgs/msg/String"
    path = write(tmp_path / "upload.x", name, [ROS2.types[name](data="hello")] * 3, ROS2, ros1=False)
    with pytest.raises(InvalidDataError, match=r"/state \(std_msgs/String, 3 messages\), expected a topic of type"):
        read(path, "rosbag2")
    with pytest.raises(InvalidRequestError, match=r"topic is /state of type std_msgs/String \(cdr\)"):
        read(path, "rosbag2", ReadOptions(topic="/state"))


def test_a_type_without_its_definition_is_refused_with_the_reason(tmp_path):
    import sqlite3

    name = "franka_msgs/msg/FrankaState"
    store = store_with(name, FRANKA_STATE.replace("tau_J", "tau_j"), ROS2)
    path = write(tmp_path / "upload.x", name, [filled(store, name)], store, ros1=False)
    with sqlite3.connect(path) as database:
        database.execute("DROP TABLE message_definitions")
    database.close()
    with pytest.raises(InvalidDataError, match="of type franka_msgs/FrankaState, without its definition"):
        read(path, "rosbag2")

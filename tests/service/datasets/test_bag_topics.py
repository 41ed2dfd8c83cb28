"""The choice of the topic, and the message types: joint states, Franka states and controller states."""

import sqlite3
from typing import Any

import numpy as np
import pytest

from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError, InvalidRequestError
from tests.service.datasets.bag_writers import (
    ROS1,
    ROS2,
    START,
    bare,
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
    """Return a type store with one more type."""
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if base is ROS1 else typesys.Stores.ROS2_HUMBLE)
    store.register(typesys.get_types_from_msg(text, name))
    return store


def write(path, name: str, messages: list[Any], store: Any, ros1: bool):
    """Write messages on the topic /state at 1 kHz."""
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
    """Return a message; fields that are not given are zero."""
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


def forget_definitions(path):
    """Remove the message definitions, which ROS 2 Humble does not record."""
    with sqlite3.connect(path) as database:
        database.execute("DROP TABLE message_definitions")
    database.close()


def stamp(store: Any, number: int) -> Any:
    """Return a header whose stamp is `number` ms after the start."""
    time = START + number * 10**6
    return filled(
        store,
        "std_msgs/msg/Header",
        stamp=store.types["builtin_interfaces/msg/Time"](sec=time // 10**9, nanosec=time % 10**9),
        frame_id="base",
    )


def check_forty(tmp_path, name, text, base, fields, with_definition=True, options=None):
    """Write and read 40 states of 7 joints. fields: (store, positions, velocities, efforts) → fields."""
    store, numbers = store_with(name, text, base), np.random.default_rng(0).normal(size=(40, 3, 7))
    messages = [
        filled(store, name, header=stamp(store, number), **fields(store, *each)) for number, each in enumerate(numbers)
    ]
    path = write(tmp_path / "upload.x", name, messages, store, base is ROS1)
    if not with_definition:
        forget_definitions(path)
    result = read(path, "rosbag1" if base is ROS1 else "rosbag2", options)
    np.testing.assert_array_equal(result.rows[:, 1:], numbers.reshape(40, -1))
    np.testing.assert_array_equal(result["t"], np.arange(40) / 1000)
    return result


@pytest.mark.parametrize(("base", "torque"), [(ROS1, "tau_J"), (ROS2, "tau_j")])
def test_franka_state(tmp_path, base, torque):
    def fields(store, q, dq, tau):
        return {"q": q, "dq": dq, "q_d": q + 9, torque: tau}

    state = "franka_msgs/msg/FrankaState", FRANKA_STATE.replace("tau_J", torque), base, fields
    result = check_forty(tmp_path, *state)
    assert result.joint_names == tuple(f"joint{joint}" for joint in range(1, 8))
    assert result.units["joint3/effort"] == "N·m"
    (tmp_path / "named").mkdir()
    assert check_forty(tmp_path / "named", *state, options=ReadOptions(joint_names=JOINTS)).joint_names == JOINTS


@pytest.mark.parametrize("with_definition", [True, False])
def test_franka_robot_state(tmp_path, with_definition):
    """Without its definition, as ROS 2 Humble records it, the known start of the message is read."""

    def fields(store, *numbers):
        def state(q, dq, tau):
            kind = store.types["sensor_msgs/msg/JointState"]
            header = filled(store, "std_msgs/msg/Header")
            return kind(header=header, name=list(JOINTS), position=q, velocity=dq, effort=tau)

        return {"measured_joint_state": state(*numbers), "desired_joint_state": state(*(np.array(numbers) + 5))}

    name = "franka_msgs/msg/FrankaRobotState"
    assert check_forty(tmp_path, name, FRANKA_ROBOT_STATE, ROS2, fields, with_definition).joint_names == JOINTS


def test_state_of_a_controller(tmp_path):
    def fields(store, *numbers):
        def point(q, dq, tau):
            kind = "trajectory_msgs/msg/JointTrajectoryPoint"
            return filled(store, kind, positions=q, velocities=dq, effort=tau)

        points = {"desired": point(*(np.array(numbers) + 3)), "actual": point(*numbers)}
        return {"joint_names": list(JOINTS), **points}

    name = "control_msgs/msg/JointTrajectoryControllerState"
    assert check_forty(tmp_path, name, CONTROLLER, ROS1, fields).joint_names == JOINTS


def test_several_topics_need_a_choice(tmp_path):
    written = states(30)
    for each in written[::3]:
        each.topic = "/desired"
    for path, kind in (
        (write_mcap(tmp_path / "a.mcap", written), "mcap"),
        (write_rosbag1(tmp_path / "a.bag", written), "rosbag1"),
        (bare(write_rosbag2(tmp_path / "bag", written), tmp_path / "a.db3"), "rosbag2"),
    ):
        with pytest.raises(InvalidDataError, match="Set `topic`, because the bag has several") as error:
            read(path, kind)
        assert "/desired (sensor_msgs/JointState, 10 messages)" in str(error.value)
        assert "/joint_states (sensor_msgs/JointState, 20 messages)" in str(error.value)
        with pytest.raises(InvalidRequestError, match=r"topic is /other, expected one of .*/desired"):
            read(path, kind, ReadOptions(topic="/other"))
        result = read(path, kind, ReadOptions(topic="/joint_states"))
        np.testing.assert_array_equal(result.rows, table_of(each for each in written if each.topic == "/joint_states"))


def test_bag_without_joint_states_is_rejected_with_its_topics(tmp_path):
    name = "std_msgs/msg/String"
    path = write(tmp_path / "upload.x", name, [ROS2.types[name](data="hello")] * 3, ROS2, ros1=False)
    with pytest.raises(InvalidDataError, match=r"/state \(std_msgs/String, 3 messages\), expected a topic of type"):
        read(path, "rosbag2")
    with pytest.raises(InvalidRequestError, match=r"topic is /state of type std_msgs/String \(cdr\)"):
        read(path, "rosbag2", ReadOptions(topic="/state"))


def test_type_without_its_definition_is_rejected(tmp_path):
    name = "franka_msgs/msg/FrankaState"
    store = store_with(name, FRANKA_STATE.replace("tau_J", "tau_j"), ROS2)
    path = write(tmp_path / "upload.x", name, [filled(store, name)], store, ros1=False)
    forget_definitions(path)
    with pytest.raises(InvalidDataError, match="of type franka_msgs/FrankaState, whose definition is not in the bag"):
        read(path, "rosbag2")

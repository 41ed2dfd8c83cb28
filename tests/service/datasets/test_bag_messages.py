"""Messages of any type are read by the names of their fields, and positions and torques of several topics are merged.

The definitions are those of the packages named: kortex_driver, iiwa_msgs, lbr_fri_idl, control_msgs and std_msgs.
"""

import json
from typing import Any

import numpy as np
import pytest

from service.datasets.formats.opening import open_table, sniff
from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError
from tests.service.datasets import bag_writers as bags
from tests.service.datasets.bag_writers import ROS1, ROS2, START, read
from tests.service.datasets.test_bag_topics import filled, forget_definitions, store_with

SEPARATOR = "\n" + "=" * 80 + "\nMSG: "
KORTEX = SEPARATOR.join(
    (
        "uint32 frame_id\nBaseFeedback base\nActuatorFeedback[] actuators",
        "kortex_driver/BaseFeedback\nuint32 active_state\nfloat32 arm_voltage\nfloat32 tool_pose_x",
        "kortex_driver/ActuatorFeedback\nuint32 command_id\nuint32 status_flags\nuint32 jitter_comm\nfloat32 position\n"
        "float32 velocity\nfloat32 torque\nfloat32 current_motor\nfloat32 voltage\nfloat32 temperature_motor",
    )
)
QUANTITY = SEPARATOR + "iiwa_msgs/JointQuantity\n" + "\n".join(f"float32 a{j}" for j in range(1, 8))
IIWA = {name: f"Header header\nJointQuantity {name.lower()}{QUANTITY}" for name in ("Position", "Velocity", "Torque")}
LBR = """float64[7] commanded_joint_position
float64[7] commanded_torque
int8 control_mode
float64[7] external_torque
float64[7] ipo_joint_position
float64[7] measured_joint_position
float64[7] measured_torque
float64 sample_time
uint32 time_stamp_nano_sec
uint32 time_stamp_sec
float64 tracking_performance
"""
INTERFACES = "std_msgs/Header header\nstring[] joint_names\nInterfaceValue[] interface_values" + (
    SEPARATOR + "control_msgs/InterfaceValue\nstring[] interface_names\nfloat64[] values"
)
STEP = 10**7
RNG = np.random.default_rng(3)
NUMBERS = RNG.normal(size=(40, 3, 7)).astype(np.float32).astype(float)
"""Positions, velocities and torques of seven joints, which are floats of 32 bits."""


def stamped(time: int) -> dict[str, Any]:
    return {"header": {"stamp": dict(zip(("sec", "nanosec"), divmod(time, 10**9), strict=True))}}


def write(path, base, topics: dict[str, tuple[str, str, list[dict[str, Any]]]]):
    """Write a bag with topics at 100 Hz; of each the type's name and definition, and the fields of its messages."""
    writer = bags.rosbag1.Writer(path) if base is ROS1 else bags.rosbag2.Writer(path.with_suffix(""), version=9)
    with writer:
        for topic, (name, text, rows) in topics.items():
            store = store_with(name, text, base) if text else base
            connection = writer.add_connection(topic, name, typestore=store)
            serialize = store.serialize_ros1 if base is ROS1 else store.serialize_cdr
            for number, fields in enumerate(rows):
                time = START + number * STEP
                writer.write(connection, time, serialize(filled(store, name, stamped(time) | fields), name))
    return path if base is ROS1 else bags.bare(path.with_suffix(""), path)


def check(result, numbers=NUMBERS, quantities=(0, 1, 2)):
    expected = numbers[:, list(quantities)].reshape(len(numbers), -1)
    np.testing.assert_array_equal(result.rows[:, 1:], expected)
    np.testing.assert_array_equal(result["t"], np.arange(len(numbers)) / 100)


def test_kortex_feedback_is_read_in_degrees(tmp_path):
    store = store_with("kortex_driver/msg/BaseCyclic_Feedback", KORTEX, ROS1)
    actuator = "kortex_driver/msg/ActuatorFeedback"
    rows = [
        {
            "actuators": [
                filled(store, actuator, {"position": q, "velocity": dq, "torque": tau, "current_motor": 9.0})
                for q, dq, tau in each.T
            ]
        }
        for each in NUMBERS
    ]
    topic = {"/my_gen3/base_feedback": ("kortex_driver/msg/BaseCyclic_Feedback", KORTEX, rows)}
    result = read(write(tmp_path / "a.bag", ROS1, topic))
    check(result)
    assert [result.units[f"joint3/{each}"] for each in ("position", "velocity", "torque")] == ["deg", "deg/s", "N·m"]
    assert "times are reception times because the messages have no stamps" in result.facts


def iiwa() -> dict[str, tuple[str, str, list[Any]]]:
    return {
        f"/iiwa/state/Joint{name}": (
            f"iiwa_msgs/msg/Joint{name}",
            IIWA[name],
            [{name.lower(): {f"a{j + 1}": each[place, j] for j in range(7)}} for each in NUMBERS],
        )
        for place, name in enumerate(IIWA)
    }


def test_topics_of_an_iiwa_are_merged_by_time(tmp_path):
    path = write(tmp_path / "a.bag", ROS1, iiwa())
    for topic in (None, "/iiwa/state/JointPosition, /iiwa/state/JointTorque,/iiwa/state/JointVelocity"):
        result = read(path, ReadOptions(topic=topic))
        check(result)
        assert result.units["joint7/torque"] == "N·m"
    without = read(path, ReadOptions(topic="/iiwa/state/JointPosition,/iiwa/state/JointTorque"))
    check(without, quantities=(0, 2))


def test_faster_topic_is_interpolated_and_gaps_stay_empty(tmp_path):
    """Torques come at 1 kHz, in a straight line and with a pause of 0.1 s; positions at 100 Hz."""
    line = np.arange(400) / 1000
    kept = [number for number in range(400) if not 150 < number < 250]
    positions = [(START + k * STEP + 300_000, dict(enumerate(each[0], start=1))) for k, each in enumerate(NUMBERS)]
    torques = [(START + k * 10**6, dict.fromkeys(range(1, 8), line[k])) for k in kept]
    path = tmp_path / "a.bag"
    with bags.rosbag1.Writer(path) as writer:
        for name, rows in (("Position", positions), ("Torque", torques)):
            kind = f"iiwa_msgs/msg/Joint{name}"
            store = store_with(kind, IIWA[name], ROS1)
            connection = writer.add_connection(f"/iiwa/{name}", kind, typestore=store)
            for time, numbers in rows:
                fields = stamped(time) | {name.lower(): {f"a{j}": each for j, each in numbers.items()}}
                writer.write(connection, time, store.serialize_ros1(filled(store, kind, fields), kind))
    result = read(path)
    torque = result["joint1/torque"]
    moments = (np.arange(40) * STEP + 300_000) / 1e9
    assert np.isnan(torque[15:25]).all()
    seen = [*range(15), *range(25, 40)]
    np.testing.assert_allclose(torque[seen], moments[seen], rtol=1e-6)
    np.testing.assert_allclose(result["joint1/position"], NUMBERS[:, 0, 0])


def test_topics_with_and_without_stamps_are_merged_by_their_reception(tmp_path):
    """Stamps of a simulation, beside messages without."""
    array = "std_msgs/msg/Float64MultiArray"
    rows = [
        {"name": [f"j{j}" for j in range(7)], "position": each[0], "header": {"stamp": {"sec": 5 + k, "nanosec": 0}}}
        for k, each in enumerate(NUMBERS)
    ]
    topics = {
        "/joint_states": (bags.JOINT_STATE, "", rows),
        "/joint_torques": (array, "", [{"data": each[2]} for each in NUMBERS]),
    }
    check(read(write(tmp_path / "a.db3", ROS2, topics)), quantities=(0, 2))
    topics["/joint_torques"] = (array, "", [{"data": each[2][:6]} for each in NUMBERS])
    with pytest.raises(InvalidDataError, match=r"topic /joint_torques has other joints .* Choose other topics"):
        read(write(tmp_path / "b.db3", ROS2, topics))


def test_lbr_state_is_read_as_measured(tmp_path):
    rows = [
        {
            **{"measured_joint_position": q, "measured_torque": tau, "commanded_torque": tau + 1, "external_torque": q},
            **{"ipo_joint_position": q + 1, "commanded_joint_position": q + 2},
            **dict(zip(("time_stamp_sec", "time_stamp_nano_sec"), divmod(START + k * STEP, 10**9), strict=True)),
        }
        for k, (q, _, tau) in enumerate(NUMBERS)
    ]
    result = read(write(tmp_path / "a.db3", ROS2, {"/lbr/state": ("lbr_fri_idl/msg/LBRState", LBR, rows)}))
    check(result, quantities=(0, 2))
    assert result.units["joint1/torque"] == "N·m"
    assert "times are header stamps" in result.facts


@pytest.mark.parametrize("with_definition", [True, False], ids=["with definition", "as ROS 2 Humble records it"])
def test_dynamic_joint_states_are_read(tmp_path, with_definition):
    """Joints have different interfaces, in different orders; the gripper has no effort."""
    joints, store = ["b", "a", "gripper"], store_with("control_msgs/msg/DynamicJointState", INTERFACES, ROS2)
    interfaces = [("position", "velocity", "effort"), ("effort", "position", "velocity"), ("position",)]
    kind = store.types["control_msgs/msg/InterfaceValue"]
    rows = []
    for each in NUMBERS:
        of = dict(zip(bags.QUANTITIES, each, strict=True))
        values = [
            kind(interface_names=list(names), values=np.array([of[name][j] for name in names]))
            for j, names in enumerate(interfaces)
        ]
        rows.append({"joint_names": joints, "interface_values": values})
    path = write(tmp_path / "a.db3", ROS2, {"/states": ("control_msgs/msg/DynamicJointState", INTERFACES, rows)})
    if not with_definition:
        forget_definitions(path)
    result = read(path)
    assert result.joint_names == ("b", "a", "gripper")
    np.testing.assert_array_equal(result["a/effort"], NUMBERS[:, 2, 1])
    np.testing.assert_array_equal(result["gripper/position"], NUMBERS[:, 0, 2])
    assert np.isnan(result["gripper/effort"]).all()


def test_arrays_are_understood_by_the_names_of_their_topics(tmp_path):
    array = "std_msgs/msg/Float64MultiArray"
    topics = {
        f"/{name}": (array, "", [{"data": each[place]} for each in NUMBERS])
        for place, name in ((0, "joint_positions"), (2, "joint_torques"), (1, "external_torques"))
    }
    topics["/joint_position_commands"] = (array, "", [{"data": each[0] + 1} for each in NUMBERS])
    result = read(write(tmp_path / "a.db3", ROS2, topics))
    check(result, quantities=(0, 2))


def test_effort_of_a_second_topic_of_joint_states_is_used(tmp_path):
    store = ROS2
    states = [{"name": list("abc"), "position": each[0, :3], "velocity": each[1, :3]} for each in NUMBERS]
    torques = [{"name": list("cab"), "effort": each[2, [2, 0, 1]]} for each in NUMBERS]
    topics = {"/joint_states": (bags.JOINT_STATE, "", states), "/ft/joint_torques": (bags.JOINT_STATE, "", torques)}
    result = read(write(tmp_path / "a.db3", store, topics))
    np.testing.assert_array_equal(result.rows[:, 1:], NUMBERS[:, :, :3].reshape(40, -1))
    topics["/other_torques"] = (bags.JOINT_STATE, "", torques)
    with pytest.raises(InvalidDataError, match="Set `topic`"):
        read(write(tmp_path / "b.db3", store, topics))


def test_measured_joint_states_are_chosen_before_commanded_ones_and_other_types(tmp_path):
    rows = [{"name": list("abc"), **dict(zip(bags.QUANTITIES, each[:, :3], strict=True))} for each in NUMBERS]
    topics = {
        "/joint_commands": (bags.JOINT_STATE, "", rows[:9]),
        "/joint_states": (bags.JOINT_STATE, "", rows),
        "/lbr/state": ("lbr_fri_idl/msg/LBRState", LBR, [{"measured_torque": np.ones(7)}]),
    }
    result = read(write(tmp_path / "a.db3", ROS2, topics))
    np.testing.assert_array_equal(result.rows[:, 1:], NUMBERS[:, :, :3].reshape(40, -1))
    assert "topics not read: /joint_commands, /lbr/state" in result.facts
    commanded = read(tmp_path / "a.db3", ReadOptions(topic="/joint_commands"))
    assert commanded.names[-1] == "c/commanded_effort"


def write_json(path, numbers):
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("JointStates", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/joints", "json", schema)
        for k, each in enumerate(numbers):
            time = START + k * STEP
            stamp = dict(zip(("sec", "nsec"), divmod(time, 10**9), strict=True))
            joints = [
                {"name": f"j{j}", "position": q, "velocity": dq, "effort": tau} for j, (q, dq, tau) in enumerate(each.T)
            ]
            writer.add_message(channel, time + 77, json.dumps({"timestamp": stamp, "joints": joints}).encode(), time)
        writer.finish()
    return path


def test_mcap_of_json_is_read(tmp_path):
    result = read(write_json(tmp_path / "a.mcap", NUMBERS))
    check(result)
    assert result.joint_names == tuple(f"j{j}" for j in range(7))


def joint_states_of_protobuf():
    """Return the message class of a Protobuf schema, made without a compiler."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    field = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="states.proto", package="lab", syntax="proto3")
    stamp = file.message_type.add(name="Stamp")
    stamp.field.add(name="seconds", number=1, type=field.TYPE_INT64, label=field.LABEL_OPTIONAL)
    stamp.field.add(name="nanos", number=2, type=field.TYPE_INT32, label=field.LABEL_OPTIONAL)
    states = file.message_type.add(name="JointStates")
    states.field.add(
        name="timestamp", number=1, type=field.TYPE_MESSAGE, type_name=".lab.Stamp", label=field.LABEL_OPTIONAL
    )
    states.field.add(name="joint_names", number=2, type=field.TYPE_STRING, label=field.LABEL_REPEATED)
    for number, name in enumerate(("q", "dq", "tau_measured", "tau_ext"), start=3):
        states.field.add(name=name, number=number, type=field.TYPE_DOUBLE, label=field.LABEL_REPEATED)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("lab.JointStates"))


def write_protobuf(path, numbers):
    from mcap_protobuf.writer import Writer

    kind = joint_states_of_protobuf()
    with path.open("wb") as file, Writer(file) as writer:
        for k, (q, dq, tau) in enumerate(numbers):
            time = START + k * STEP
            message = kind(q=q, dq=dq, tau_measured=tau, tau_ext=tau + 3, joint_names=[f"j{j}" for j in range(7)])
            message.timestamp.seconds, message.timestamp.nanos = divmod(time, 10**9)
            writer.write_message("/robot", message, log_time=time + 5, publish_time=time)
    return path


def test_mcap_of_protobuf_is_read(tmp_path):
    result = read(write_protobuf(tmp_path / "a.mcap", NUMBERS))
    check(result)
    assert result.joint_names == tuple(f"j{j}" for j in range(7))
    assert "times are header stamps" in result.facts


def echo(numbers, ros1=False, stamped=True):
    """Return what `ros2 topic echo` prints, or `rostopic echo`."""
    import yaml

    documents = []
    for k, (q, dq, tau) in enumerate(numbers):
        stamp = dict(
            zip(("secs", "nsecs") if ros1 else ("sec", "nanosec"), divmod(START + k * STEP, 10**9), strict=True)
        )
        header = {"header": {"stamp": stamp, "frame_id": ""}} if stamped else {}
        names = [f"j{j}" for j in range(7)]
        body = header | {"name": names, "position": q.tolist(), "velocity": dq.tolist(), "effort": tau.tolist()}
        documents.append(yaml.dump(body, sort_keys=False, default_flow_style=ros1 and None))
    return "---\n".join([*documents, ""])


@pytest.mark.parametrize("ros1", [True, False])
def test_text_of_topic_echo_is_read(tmp_path, ros1):
    (tmp_path / "states.txt").write_text(echo(NUMBERS, ros1))
    assert sniff(tmp_path / "states.txt") == "yaml"
    result = read(tmp_path / "states.txt")
    check(result)
    assert result.joint_names == tuple(f"j{j}" for j in range(7))
    (tmp_path / "cut.txt").write_text(echo(NUMBERS, ros1)[:-200])
    cut = read(tmp_path / "cut.txt")
    assert len(cut.rows) == 39
    assert any("last record is cut off" in fact for fact in cut.facts)


def test_echoed_messages_without_stamps_need_a_time_step(tmp_path):
    (tmp_path / "states.yaml").write_text(echo(NUMBERS, stamped=False))
    result = read(tmp_path / "states.yaml")
    assert result.names[0] == "j0/position"
    with open_table(tmp_path / "states.yaml", "yaml", ReadOptions(dt=0.01), bags.SETTINGS) as table:
        assert table.names[0] == "t"


def test_yaml_with_aliases_is_refused(tmp_path):
    bomb = "a: &a [1, 2]\nb: &b [*a, *a]\nposition: [*b, *b]\n---\n"
    (tmp_path / "bomb.yaml").write_text(bomb)
    with pytest.raises(InvalidDataError, match="anchors and aliases are not read"):
        read(tmp_path / "bomb.yaml")

"""Decoding messages to objects: ROS 1 and ROS 2 by `rosbags`, Protobuf by `mcap-protobuf-support`, and JSON."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import yaml
from mcap import records
from mcap_protobuf.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.msg import normalize_msgtype

from service.datasets.formats.bags.containers import Topic
from service.datasets.formats.table import first_line, unreadable
from service.foundation.errors import invalid_data

ENCODINGS = ("cdr", "ros1", "json", "protobuf", "yaml")
MAX_DEFINITION_BYTES = 256 * 1024
MAX_SEQUENCE = 1_000_000
"""Max length of a list in a message; without it, a list of messages without fields could have any length."""
# rosbag2 stores no definitions before ROS 2 Iron
_HUMBLE = {
    "control_msgs/msg/DynamicJointState": "std_msgs/Header header\nstring[] joint_names\n"
    "InterfaceValue[] interface_values",
    "control_msgs/msg/InterfaceValue": "string[] interface_names\nfloat64[] values",
    # of franka_ros2: only the start of the message, as later fields differ between its releases
    "franka_msgs/msg/FrankaRobotState": "std_msgs/Header header\nCollisionIndicators collision_indicators\n"
    "sensor_msgs/JointState measured_joint_state",
    "franka_msgs/msg/CollisionIndicators": "geometry_msgs/Vector3 is_cartesian_linear_collision\n"
    "geometry_msgs/Vector3 is_cartesian_angular_collision\ngeometry_msgs/Vector3 is_cartesian_linear_contact\n"
    "geometry_msgs/Vector3 is_cartesian_angular_contact\nfloat64[7] is_joint_collision\nfloat64[7] is_joint_contact",
}
_ALIAS = re.compile(rb"(?m)(?:^|[:,\[{-])\s*[&*]\w")
Decoder = Callable[[bytes], Any]


def make_decoder(topic: Topic) -> Decoder:
    """Return a function that decodes a message of a topic; raise InvalidDataError if its type is not defined.

    The function may raise any error if a message is damaged.
    """
    if len(topic.definition) > MAX_DEFINITION_BYTES:
        value = f"{len(topic.definition)} bytes long"
        raise invalid_data(f"definition of {topic.type}", value, f"at most {MAX_DEFINITION_BYTES} bytes")
    try:
        if topic.encoding == "json":
            return lambda data: json.loads(data, object_hook=lambda fields: SimpleNamespace(**fields))
        if topic.encoding == "yaml":
            return _decode_yaml
        if topic.encoding == "protobuf":
            schema = records.Schema(id=1, name=topic.type, encoding=topic.language, data=topic.definition)
            if (decoder := DecoderFactory().decoder_for(topic.encoding, schema)) is not None:
                return decoder
        return _ros_decoder(topic)
    except KeyError:
        value = f"of type {topic.type}, whose definition is not in the bag"
        expected = "a bag with message definitions, as ROS 2 records since Iron and in MCAP"
        raise invalid_data(f"topic {topic.name}", value, expected) from None
    except Exception as error:  # from parsing definitions, which come with the upload
        raise unreadable(f"definition of {topic.type}", first_line(error), "a message definition") from None


def _decode_yaml(data: bytes) -> Any:
    if _ALIAS.search(data):
        raise ValueError("anchors and aliases are not read")
    return _named(yaml.load(data, getattr(yaml, "CSafeLoader", yaml.SafeLoader)))  # noqa: S506 - both are safe


def _named(value: Any) -> Any:
    """Return dictionaries as objects with attributes."""
    if isinstance(value, dict):
        return SimpleNamespace(**{str(name): _named(each) for name, each in value.items()})
    return [_named(each) for each in value] if isinstance(value, list) else value


def _ros_decoder(topic: Topic) -> Decoder:
    name = normalize_msgtype(topic.type)
    store = get_typestore(Stores.ROS1_NOETIC if topic.encoding == "ros1" else Stores.ROS2_HUMBLE)
    text = topic.definition.decode(errors="replace").strip()
    if topic.language.endswith("idl"):
        types = get_types_from_idl(text)
    elif text:
        types = get_types_from_msg(text, name)
    else:
        types = {}
        for each, known in _HUMBLE.items():
            types |= get_types_from_msg(known, each)
    store.max_sequence_length = MAX_SEQUENCE
    for each in types:  # the bag's definition replaces that of the store
        store.types.pop(each, None)
        store.fielddefs.pop(each, None)
    store.register(types)
    definition = store.get_msgdef(name)
    if topic.encoding == "ros1":
        return lambda data: store.deserialize_ros1(data, name)
    if text or name not in _HUMBLE:
        return lambda data: store.deserialize_cdr(data, name)

    def decode_start(data: bytes) -> Any:
        read = definition.deserialize_cdr_le if data[1] else definition.deserialize_cdr_be
        return read(data[4:], 0, definition.cls, store)[0]

    return decode_start

"""Message definitions as text (http://wiki.ros.org/msg): which fields a message has, in order."""

from __future__ import annotations

import re
from dataclasses import dataclass

from service.datasets.formats.bags.container import type_name

LONGEST = 256 * 1024
SEQUENCE = -1
SIZES = {
    **dict.fromkeys(("bool", "byte", "char", "int8", "uint8"), 1),
    **dict.fromkeys(("int16", "uint16"), 2),
    **dict.fromkeys(("int32", "uint32", "float32"), 4),
    **dict.fromkeys(("int64", "uint64", "float64"), 8),
}
"""Bytes of the numbers that fields consist of."""
_LINE = re.compile(
    r"\s*(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?:\[(?P<bound><=)?(?P<count>\d*)\])?\s+(?P<name>[A-Za-z]\w*)(?P<rest>.*)"
)


@dataclass(frozen=True)
class Field:
    """One field.

    type: of SIZES, `string`, `time`, `duration` or of a message; count: None of one, SEQUENCE, or fixed.
    """

    name: str
    type: str
    count: int | None


Types = dict[str, tuple[Field, ...]]
"""Fields of messages by type."""


def parse(text: str, root: str) -> Types:
    """Fields of the type `root` and of those that follow it in `text`; raise ValueError."""
    if len(text) > LONGEST:
        raise ValueError(f"a definition of {len(text)} characters, expected at most {LONGEST}")
    types: Types = {}
    name, fields = root, list[Field]()
    for number, line in enumerate([*text.splitlines(), "MSG: end/End"]):
        if line.startswith("MSG:"):
            if number or fields:  # rosbags and others write the first type's name too
                types[name] = tuple(fields)
            name, fields = type_name(line[4:].strip()), []
        elif field := _field(line, name):
            fields.append(field)
    return types


def _field(line: str, owner: str) -> Field | None:
    line = line.strip()
    if not line or line.startswith(("#", "=", "@")):
        return None
    found = _LINE.match(line)
    if found is None:
        raise ValueError(f"{line[:80]!r} in the definition of {owner}")
    if found["rest"].lstrip().startswith("="):  # a constant
        return None
    count = None
    if found["count"] is not None:
        count = SEQUENCE if found["bound"] or not found["count"] else int(found["count"][:9])
    kind = type_name(found["type"])
    if kind in SIZES or kind in ("string", "wstring", "time", "duration"):
        return Field(found["name"], kind, count)
    if kind == "Header":
        kind = "std_msgs/Header"
    elif "/" not in kind:
        kind = f"{owner.partition('/')[0]}/{kind}"
    return Field(found["name"], kind, count)


_JOINT_STATE = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
"""
_STAMP = """MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
MSG: builtin_interfaces/Duration
int32 sec
uint32 nanosec
"""
_VECTOR = """MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""
# the beginning of what franka_ros2 publishes: the fields that follow differ between its releases
_FRANKA_ROBOT_STATE = """std_msgs/Header header
CollisionIndicators collision_indicators
sensor_msgs/JointState measured_joint_state
uint8 what_follows
MSG: franka_msgs/CollisionIndicators
geometry_msgs/Vector3 is_cartesian_linear_collision
geometry_msgs/Vector3 is_cartesian_angular_collision
geometry_msgs/Vector3 is_cartesian_linear_contact
geometry_msgs/Vector3 is_cartesian_angular_contact
float64[7] is_joint_collision
float64[7] is_joint_contact
"""


def well_known(encoding: str) -> Types:
    """Types whose definition need not be in the bag: rosbag2 stores none before ROS 2 Iron."""
    types = parse(_JOINT_STATE, "sensor_msgs/JointState")
    if encoding == "ros1":
        header = "uint32 seq\ntime stamp\nstring frame_id"
        return types | parse(header, "std_msgs/Header")
    types |= parse("builtin_interfaces/Time stamp\nstring frame_id", "std_msgs/Header") | parse(_STAMP, "")
    return types | parse(_FRANKA_ROBOT_STATE + _VECTOR, "franka_msgs/FrankaRobotState")

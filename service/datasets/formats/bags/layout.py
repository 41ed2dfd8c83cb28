"""Parsing message definitions, and finding the fields of a message in its bytes, in CDR (ROS 2) or ROS 1 encoding.

Definitions: http://wiki.ros.org/msg.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from struct import Struct

from service.datasets.formats.bags.container import type_name

MAX_DEFINITION_CHARS = 256 * 1024
CDR_HEADER_BYTES = 4
SEQUENCE = -1
SIZES = {
    **dict.fromkeys(("bool", "byte", "char", "int8", "uint8"), 1),
    **dict.fromkeys(("int16", "uint16"), 2),
    **dict.fromkeys(("int32", "uint32", "float32"), 4),
    **dict.fromkeys(("int64", "uint64", "float64"), 8),
}
"""Size in bytes by type of number."""
_LINE = re.compile(
    r"\s*(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?:\[(?P<bound><=)?(?P<count>\d*)\])?\s+(?P<name>[A-Za-z]\w*)(?P<rest>.*)"
)


@dataclass(frozen=True)
class Field:
    """A field of a message."""

    name: str
    type: str
    """One of SIZES, `string`, `time`, `duration`, or a message type."""
    count: int | None
    """None for a single value, SEQUENCE, or the length of an array."""


Types = dict[str, tuple[Field, ...]]
"""Fields by message type."""


def parse_definition(text: str, root: str) -> Types:
    """Parse the definition of the type `root` and of the types after it in `text`; raise ValueError."""
    if len(text) > MAX_DEFINITION_CHARS:
        raise ValueError(f"it has {len(text)} characters, expected at most {MAX_DEFINITION_CHARS}")
    types: Types = {}
    name, fields = root, list[Field]()
    for number, line in enumerate([*text.splitlines(), "MSG: end/End"]):
        if line.startswith("MSG:"):
            if number or fields:  # some writers also name the first type
                types[name] = tuple(fields)
            name, fields = type_name(line[4:].strip()), []
        elif field := _field(line, name):
            fields.append(field)
    return types


def _field(line: str, owner: str) -> Field | None:
    line = line.strip()
    if not line or line.startswith(("#", "=", "@")):
        return None
    match = _LINE.match(line)
    if match is None:
        raise ValueError(f"{line[:80]!r} is not a field of {owner}")
    if match["rest"].lstrip().startswith("="):  # a constant
        return None
    count = None
    if match["count"] is not None:
        count = SEQUENCE if match["bound"] or not match["count"] else int(match["count"][:9])
    kind = type_name(match["type"])
    if kind in SIZES or kind in ("string", "wstring", "time", "duration"):
        return Field(match["name"], kind, count)
    if kind == "Header":
        kind = "std_msgs/Header"
    elif "/" not in kind:
        kind = f"{owner.partition('/')[0]}/{kind}"
    return Field(match["name"], kind, count)


# the start of franka_ros2's message; later fields differ between its releases
_DEFINITIONS = """std_msgs/Header header
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
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
MSG: sensor_msgs/JointState
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
MSG: builtin_interfaces/Duration
int32 sec
uint32 nanosec
"""


def known_types(encoding: str) -> Types:
    """Return the types that need no definition in the bag; rosbag2 stores none before ROS 2 Iron."""
    types = parse_definition(_DEFINITIONS, "franka_msgs/FrankaRobotState")
    if encoding != "ros1":
        return types
    joint_state = "sensor_msgs/JointState"
    return {joint_state: types[joint_state]} | parse_definition(
        "uint32 seq\ntime stamp\nstring frame_id", "std_msgs/Header"
    )


@dataclass
class Layout:
    """Layout of all messages that have the same size, texts and lengths of sequences."""

    length: int
    """Size of a message in bytes."""
    big_endian: bool = False
    numbers: dict[str, tuple[int, int, str]] = field(default_factory=dict)
    """First byte, count and type of numbers by the path of their field, such as `header.stamp`."""
    texts: dict[str, list[str]] = field(default_factory=dict)
    """Texts by the path of their field."""
    fixed: list[tuple[int, bytes]] = field(default_factory=list)
    """Bytes that are equal in all these messages: (first byte, bytes)."""
    fields: int = 0
    """Number of fields."""

    def fits(self, data: bytes) -> bool:
        """Return whether a message has this layout."""
        return len(data) == self.length and all(data.startswith(known, at) for at, known in self.fixed)


def find_layout(data: bytes, types: Types, root: str, last: str, encoding: str) -> Layout:
    """Return the layout of a message of type `root` up to its field `last`; raise ValueError if it does not fit."""
    layout = Layout(len(data))
    if encoding == "cdr":
        if len(data) < CDR_HEADER_BYTES or data[0] != 0 or data[1] > 1:
            raise ValueError("it is not plain CDR")
        layout.big_endian = data[1] == 0
        layout.fixed.append((0, data[:2]))
    finder = _LayoutFinder(data, types, layout, encoding == "cdr")
    finder.message(root, "", 0, last)
    left = len(data) - finder.at
    if types[root][-1].name == last and left > (3 if encoding == "cdr" else 0):  # some writers pad CDR
        raise ValueError(f"it has {left} bytes too many")
    layout.fixed = _merged(layout.fixed)
    return layout


class _LayoutFinder:
    def __init__(self, data: bytes, types: Types, layout: Layout, cdr: bool) -> None:
        self.data, self.types, self.layout, self.cdr = data, types, layout, cdr
        self.at = CDR_HEADER_BYTES if cdr else 0
        self.length = Struct(">I" if layout.big_endian else "<I")

    def message(self, name: str, path: str, depth: int, last: str | None = None) -> None:
        if name not in self.types:
            raise ValueError(f"type {name} has no definition")
        if depth > 32:
            raise ValueError(f"type {name} is nested {depth} levels deep")
        for each in self.types[name]:
            self.field(each.type, each.count, f"{path}.{each.name}" if path else each.name, depth)
            if each.name == last:
                return
        if last is not None:
            raise ValueError(f"type {name} has no field {last}")

    def count(self) -> None:
        self.layout.fields += 1
        if self.layout.fields > 2000:
            raise ValueError("it has more than 2000 fields")

    def field(self, kind: str, count: int | None, path: str, depth: int) -> None:
        self.count()
        if count == SEQUENCE:
            count = self.sequence_length()
            if kind in SIZES and count == 0:
                self.layout.numbers[path] = (self.at, 0, kind)
                return
        if kind in SIZES:
            many = 1 if count is None else count
            self.align(SIZES[kind])
            self.layout.numbers[path] = (self.at, many, kind)
            self.skip(many * SIZES[kind])
        elif kind in ("time", "duration"):  # of ROS 1
            if count is None:
                self.layout.numbers[path] = (self.at, 1, kind)
            self.skip(8 * (1 if count is None else count))
        elif count is None:
            self.element(kind, path, depth)
        else:
            # every element takes at least a byte, except messages without fields
            if count > len(self.data):
                raise ValueError(f"{path} declares {count} elements in {len(self.data)} bytes")
            for index in range(count):
                self.element(kind, path if kind == "string" else f"{path}[{index}]", depth)

    def element(self, kind: str, path: str, depth: int) -> None:
        self.count()
        if kind == "string":
            self.layout.texts.setdefault(path, []).append(self.text())
        elif kind == "wstring":
            raise ValueError(f"{path} is a wstring, which is not supported")
        else:
            self.message(kind, path, depth + 1)

    def text(self) -> str:
        length = self.sequence_length()
        start = self.at
        self.skip(length)
        self.layout.fixed.append((start, self.data[start : self.at]))
        raw = self.data[start : self.at]
        return (raw[:-1] if self.cdr and raw.endswith(b"\x00") else raw).decode()

    def sequence_length(self) -> int:
        self.align(4)
        start = self.at
        self.skip(4)
        self.layout.fixed.append((start, self.data[start : self.at]))
        length: int = self.length.unpack_from(self.data, start)[0]
        return length

    def align(self, size: int) -> None:
        if self.cdr:
            self.at += -(self.at - CDR_HEADER_BYTES) % size

    def skip(self, size: int) -> None:
        if size > len(self.data) - self.at:
            raise ValueError(
                f"{size} bytes are declared at byte {self.at}, but {max(len(self.data) - self.at, 0)} remain"
            )
        self.at += size


def _merged(fixed: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    merged: list[tuple[int, bytes]] = []
    for at, known in fixed:
        if merged and merged[-1][0] + len(merged[-1][1]) == at:
            merged[-1] = merged[-1][0], merged[-1][1] + known
        else:
            merged.append((at, known))
    return merged

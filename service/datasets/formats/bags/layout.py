"""Messages in bytes: their definitions as text (http://wiki.ros.org/msg), and where by these the fields of a message
lie, in CDR (ROS 2) or in the form of ROS 1."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from struct import Struct

from service.datasets.formats.bags.container import type_name

MAX_CHARACTERS = 256 * 1024
CDR_HEADER = 4
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
    if len(text) > MAX_CHARACTERS:
        raise ValueError(f"a definition of {len(text)} characters, expected at most {MAX_CHARACTERS}")
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
    match = _LINE.match(line)
    if match is None:
        raise ValueError(f"{line[:80]!r} in the definition of {owner}")
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


# the beginning of what franka_ros2 publishes: the fields that follow differ between its releases
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


def well_known(encoding: str) -> Types:
    """Types whose definition need not be in the bag: rosbag2 stores none before ROS 2 Iron."""
    types = parse(_DEFINITIONS, "franka_msgs/FrankaRobotState")
    if encoding != "ros1":
        return types
    joint_state = "sensor_msgs/JointState"
    return {joint_state: types[joint_state]} | parse("uint32 seq\ntime stamp\nstring frame_id", "std_msgs/Header")


@dataclass
class Layout:
    """Of messages of one length that agree in all texts and lengths of sequences.

    numbers: first byte, count and type of numbers by the path of their field, `header.stamp` for example; texts by
    path; fixed: the bytes in which such messages agree, (first byte, bytes); big_endian: of the numbers; fields: how
    many there are.
    """

    length: int
    big_endian: bool = False
    numbers: dict[str, tuple[int, int, str]] = field(default_factory=dict)
    texts: dict[str, list[str]] = field(default_factory=dict)
    fixed: list[tuple[int, bytes]] = field(default_factory=list)
    fields: int = 0

    def fits(self, data: bytes) -> bool:
        """Whether a message has this layout."""
        return len(data) == self.length and all(data.startswith(known, at) for at, known in self.fixed)


def lay_out(data: bytes, types: Types, root: str, last: str, encoding: str) -> Layout:
    """Layout of a message of type `root` up to its field `last`; raise ValueError where the bytes do not agree."""
    layout = Layout(len(data))
    if encoding == "cdr":
        if len(data) < CDR_HEADER or data[0] != 0 or data[1] > 1:
            raise ValueError("no plain CDR")
        layout.big_endian = data[1] == 0
        layout.fixed.append((0, data[:2]))
    walk = _Walk(data, types, layout, encoding == "cdr")
    walk.message(root, "", 0, last)
    left = len(data) - walk.at
    if types[root][-1].name == last and left > (3 if encoding == "cdr" else 0):  # some writers fill CDR up
        raise ValueError(f"{left} bytes too many")
    layout.fixed = _merged(layout.fixed)
    return layout


class _Walk:
    def __init__(self, data: bytes, types: Types, layout: Layout, cdr: bool) -> None:
        self.data, self.types, self.layout, self.cdr = data, types, layout, cdr
        self.at = CDR_HEADER if cdr else 0
        self.length = Struct(">I" if layout.big_endian else "<I")

    def message(self, name: str, path: str, depth: int, last: str | None = None) -> None:
        if name not in self.types:
            raise ValueError(f"type {name} without a definition")
        if depth > 32:
            raise ValueError(f"type {name} nested {depth} deep")
        for each in self.types[name]:
            self.field(each.type, each.count, f"{path}.{each.name}" if path else each.name, depth)
            if each.name == last:
                return
        if last is not None:
            raise ValueError(f"type {name} without {last}")

    def count(self) -> None:
        self.layout.fields += 1
        if self.layout.fields > 2000:
            raise ValueError("more than 2000 fields")

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
            self.one(kind, path, depth)
        else:
            # an element takes a byte at least, but for messages without fields
            if count > len(self.data):
                raise ValueError(f"{path} of {count} elements declared in {len(self.data)} bytes")
            for index in range(count):
                self.one(kind, path if kind == "string" else f"{path}[{index}]", depth)

    def one(self, kind: str, path: str, depth: int) -> None:
        self.count()
        if kind == "string":
            self.layout.texts.setdefault(path, []).append(self.text())
        elif kind == "wstring":
            raise ValueError(f"{path} is a wstring, which is not read")
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
            self.at += -(self.at - CDR_HEADER) % size

    def skip(self, size: int) -> None:
        if size > len(self.data) - self.at:
            raise ValueError(f"{size} bytes declared at byte {self.at}, {max(len(self.data) - self.at, 0)} there")
        self.at += size


def _merged(fixed: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    merged: list[tuple[int, bytes]] = []
    for at, known in fixed:
        if merged and merged[-1][0] + len(merged[-1][1]) == at:
            merged[-1] = merged[-1][0], merged[-1][1] + known
        else:
            merged.append((at, known))
    return merged

"""Decoding joint states: positions, velocities and efforts of named joints.

The messages of one channel may hold different joints, in different orders.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from service.datasets.formats.bags.container import Channel
from service.datasets.formats.bags.layout import Layout, Types, find_layout, known_types, parse_definition
from service.datasets.formats.table import unreadable
from service.foundation.errors import InvalidDataError, invalid_data, readable

ENCODINGS = ("cdr", "ros1")
MAX_KINDS = 1000
"""Max number of message kinds in a channel."""
_DTYPES = {
    "float32": "f4",
    "float64": "f8",
    **{f"{sign}int{bits}": f"{sign[:1] or 'i'}{bits // 8}" for sign in ("", "u") for bits in (8, 16, 32, 64)},
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
}
"""NumPy types of the numbers in messages."""
_JOINT_STATE = {"position": "position", "velocity": "velocity", "effort": "effort"}
_POINT = {"position": "positions", "velocity": "velocities", "acceleration": "accelerations", "effort": "effort"}


@dataclass(frozen=True)
class StateFields:
    """The fields of a message type that hold joint states."""

    last: tuple[str, ...]
    """Fields of which the last one present ends the part of the message that is read."""
    names: str | None
    """Path of the joint names; None if there are none."""
    quantities: tuple[Mapping[str, str], ...]
    """Alternatives, each a path by quantity; the first that has positions is used."""
    units: Mapping[str, str]
    """Units by quantity, if the type defines them."""


def _with_prefix(prefix: str, names: Mapping[str, str]) -> dict[str, str]:
    return {quantity: f"{prefix}.{name}" for quantity, name in names.items()}


STATE_TYPES = {
    "sensor_msgs/JointState": StateFields(("effort",), "name", (_JOINT_STATE,), {}),
    "franka_msgs/FrankaState": StateFields(
        ("tau_J", "tau_j"),
        None,
        tuple({"position": "q", "velocity": "dq", "effort": effort} for effort in ("tau_J", "tau_j")),
        {"position": "rad", "velocity": "rad/s", "effort": "N·m"},
    ),
    "franka_msgs/FrankaRobotState": StateFields(
        ("measured_joint_state",),
        "measured_joint_state.name",
        (_with_prefix("measured_joint_state", _JOINT_STATE),),
        {"position": "rad", "velocity": "rad/s", "effort": "N·m"},
    ),
    "control_msgs/JointTrajectoryControllerState": StateFields(
        ("actual", "feedback"), "joint_names", (_with_prefix("feedback", _POINT), _with_prefix("actual", _POINT)), {}
    ),
}
"""Message types that can be read."""


@dataclass(frozen=True)
class MessageKind:
    """The joints and quantities that some messages of a channel hold."""

    joints: tuple[str, ...]
    quantities: tuple[str, ...]
    named: bool = True
    """Whether the joint names come from the messages; otherwise joints are numbered."""


@dataclass(frozen=True)
class MessageForm:
    """The layout of some messages, with the positions of the stamp and of the quantities."""

    layout: Layout
    kind: MessageKind
    stamp: int
    """First byte of the stamp."""
    places: Mapping[str, tuple[int, str]]
    """First byte and NumPy type by quantity."""

    def stamps(self, rows: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Return the header times of messages (M, bytes) in ns, 0 if not set."""
        order = ">" if self.layout.big_endian else "<"
        parts = np.ascontiguousarray(rows[:, self.stamp : self.stamp + 8]).view(f"{order}u4").astype(np.int64)
        return np.asarray(parts[:, 0] * 1_000_000_000 + parts[:, 1])

    def values(self, rows: NDArray[np.uint8], quantity: str) -> Array:
        """Return a quantity of the joints in messages (M, bytes), (M, n)."""
        start, dtype = self.places[quantity]
        size = np.dtype(dtype).itemsize * len(self.kind.joints)
        return np.ascontiguousarray(rows[:, start : start + size]).view(dtype).astype(np.float64)


class Decoder:
    """Decodes the messages of a channel; raise InvalidDataError if the type's definition is missing or damaged."""

    def __init__(self, channel: Channel) -> None:
        self.channel, self.source = channel, STATE_TYPES[channel.type]
        self.types: Types = known_types(channel.encoding)
        if channel.definition is not None and channel.definition.strip():
            try:
                self.types = self.types | parse_definition(channel.definition, channel.type)
            except ValueError as error:
                raise unreadable(f"definition of {channel.type}", str(error), "a message definition") from None
        if channel.type not in self.types:
            raise invalid_data(
                f"topic {channel.topic}",
                f"of type {channel.type}, whose definition is not in the bag",
                "a bag with message definitions, as ROS 2 records since Iron and in MCAP",
            )
        fields = [each.name for each in self.types[channel.type]]
        ends = [name for name in fields if name in self.source.last]
        if not ends:
            value, expected = f"a message of {', '.join(fields)[:200]}", f"a field {' or '.join(self.source.last)}"
            raise invalid_data(f"definition of {channel.type}", value, expected)
        self.last = ends[-1]
        self._forms: list[MessageForm] = []

    def find_form(self, data: bytes, number: int) -> MessageForm:
        """Return the form of a message; raise InvalidDataError. number: counted from 1."""
        for form in self._forms:
            if form.layout.fits(data):
                return form
        form = self._new_form(data, number)
        if len(self._forms) >= 64:  # most channels have one layout
            self._forms.pop()
        self._forms.insert(0, form)
        return form

    def _new_form(self, data: bytes, number: int) -> MessageForm:
        channel = self.channel
        try:
            layout = find_layout(data, self.types, channel.type, self.last, channel.encoding)
        except ValueError as error:  # also from text that is not UTF-8
            raise unreadable(self._field(number), str(error), f"a {channel.type}") from None
        numbers = layout.numbers
        ways = [(way, _count_values(numbers, way)) for way in self.source.quantities]
        way, counts = max(ways, key=lambda each: ("position" in each[1], len(each[1])))
        joints = tuple(layout.texts.get(self.source.names, ()) if self.source.names else ())
        named = bool(joints)
        if not named:
            joints = tuple(f"joint{joint + 1}" for joint in range(counts.get("position", 0)))
        if len(set(joints)) < len(joints):
            raise self._error(number, f"a state of joints {', '.join(joints)[:150]}", "each joint only once")
        for quantity, count in counts.items():
            if count != len(joints):
                value = f"a state with {count} values of {way[quantity]}"
                raise self._error(number, value, f"{len(joints)}, one per joint")
        order = ">" if layout.big_endian else "<"
        places = {each: (numbers[way[each]][0], order + _DTYPES[numbers[way[each]][2]]) for each in counts}
        return MessageForm(layout, MessageKind(joints, tuple(counts), named), self._stamp(numbers, number), places)

    def _stamp(self, numbers: Mapping[str, tuple[int, int, str]], number: int) -> int:
        if "header.stamp" in numbers and numbers["header.stamp"][2] == "time":  # of ROS 1
            return numbers["header.stamp"][0]
        seconds, nanoseconds = numbers.get("header.stamp.sec"), numbers.get("header.stamp.nanosec")
        if seconds is None or seconds[1] != 1 or seconds[2] not in ("int32", "uint32"):
            raise self._error(number, "without a time stamp", "a header with a stamp in s and ns")
        if nanoseconds != (seconds[0] + 4, 1, "uint32"):
            raise self._error(number, "without a time stamp", "a header with a stamp in s and ns")
        return seconds[0]

    def _error(self, number: int, value: str, expected: str) -> InvalidDataError:
        return invalid_data(self._field(number), value, expected)

    def _field(self, number: int) -> str:
        return f"topic {self.channel.topic}, message {number}"


def _count_values(numbers: Mapping[str, tuple[int, int, str]], way: Mapping[str, str]) -> dict[str, int]:
    fields = {each: numbers[path] for each, path in way.items() if path in numbers}
    return {each: count for each, (_, count, kind) in fields.items() if count and kind in _DTYPES}


def choose_joints(
    kinds: Sequence[MessageKind], counts: Sequence[int], given: tuple[str, ...] | None, topic: str
) -> tuple[str, ...]:
    """Return the joints to read: those `given`, or the set with the largest weight; raise InvalidDataError.

    The weight of a set is the number of messages with all its joints times the square of its size. An arm at 30 Hz then
    wins over its gripper at 200 Hz. counts: messages of each kind.
    """
    numbers: dict[frozenset[str], int] = {}
    orders: dict[frozenset[str], tuple[str, ...]] = {}
    for kind, count in sorted(zip(kinds, counts, strict=True), key=lambda each: -each[1]):
        if "position" in kind.quantities:
            numbers[frozenset(kind.joints)] = numbers.get(frozenset(kind.joints), 0) + count
            orders.setdefault(frozenset(kind.joints), kind.joints)
    if not numbers:
        raise invalid_data(f"topic {topic}", "without positions", "messages with joint positions")
    if given is not None:
        if any(each.issuperset(given) for each in numbers):
            return given
        known = sorted(set().union(*numbers))
        raise invalid_data(
            "joint_names", ", ".join(given), f"joints out of {_listed(known)} that are in the same message"
        )

    def weight(joints: frozenset[str]) -> int:
        return len(joints) ** 2 * sum(count for other, count in numbers.items() if other >= joints)

    return orders[max(numbers, key=weight)]


def describe_choice(
    kinds: Sequence[MessageKind], counts: Sequence[int], joints: tuple[str, ...], quantities: Mapping[str, int]
) -> list[str]:
    """Return sentences about the joints that are read. quantities: number of messages that hold each."""
    facts = []
    read = [(kind, count) for kind, count in zip(kinds, counts, strict=True) if has_joints(kind, joints)]
    total, kept = sum(counts), sum(count for _, count in read)
    if kept < total:
        others = {joint for kind in kinds for joint in kind.joints} - set(joints)
        also = f"; other joints of the topic: {_listed(sorted(others))}" if others else ""
        facts.append(f"{total - kept} of {total} messages do not have all joints and were not read{also}")
    elif others := {joint for kind, _ in read for joint in kind.joints} - set(joints):
        facts.append(f"joints not read: {_listed(sorted(others))}")
    orders = {tuple(joint for joint in kind.joints if joint in joints) for kind, _ in read}
    if len(orders) > 1:
        facts.append(f"the joints come in {len(orders)} different orders and were matched by name in every message")
    facts += [
        f"{kept - count} of {kept} messages have no {quantity}"
        for quantity, count in quantities.items()
        if 0 < count < kept
    ]
    return facts


def has_joints(kind: MessageKind, joints: tuple[str, ...]) -> bool:
    """Return whether messages of a kind have the positions of all these joints."""
    return "position" in kind.quantities and set(kind.joints).issuperset(joints)


def _listed(joints: Sequence[str]) -> str:
    return ", ".join(readable(joint[:100]) for joint in joints[:20]) + (" …" if len(joints) > 20 else "")

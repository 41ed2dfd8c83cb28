"""Messages that tell the state of a robot's joints: what of them is position, velocity, effort, and of which joints, in
which order, as the messages of a channel may tell of different ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from service.datasets.formats.bags.container import Channel
from service.datasets.formats.bags.layout import Layout, Types, lay_out, parse, well_known
from service.foundation.errors import InvalidDataError, invalid_data, readable

ENCODINGS = ("cdr", "ros1")
MOST_KINDS = 1000
"""Sets of joints that the messages of a channel may tell of."""
_DTYPES = {
    "float32": "f4",
    "float64": "f8",
    **{f"{sign}int{bits}": f"{sign[:1] or 'i'}{bits // 8}" for sign in ("", "u") for bits in (8, 16, 32, 64)},
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
}
"""NumPy's types of numbers in messages."""
_JOINT_STATE = {"position": "position", "velocity": "velocity", "effort": "effort"}
_POINT = {"position": "positions", "velocity": "velocities", "acceleration": "accelerations", "effort": "effort"}


@dataclass(frozen=True)
class Source:
    """Where a type holds joints' states: one of several ways, the first that has positions.

    last: field after which the rest of the message does not matter; names: path of the joints' names, None where there
    are none; quantities: path by quantity; units: by quantity, where the type fixes them.
    """

    last: tuple[str, ...]
    names: str | None
    quantities: tuple[Mapping[str, str], ...]
    units: Mapping[str, str]


def _below(prefix: str, names: Mapping[str, str]) -> dict[str, str]:
    return {quantity: f"{prefix}.{name}" for quantity, name in names.items()}


SOURCES = {
    "sensor_msgs/JointState": Source(("effort",), "name", (_JOINT_STATE,), {}),
    "franka_msgs/FrankaState": Source(
        ("tau_J", "tau_j"),
        None,
        tuple({"position": "q", "velocity": "dq", "effort": effort} for effort in ("tau_J", "tau_j")),
        {"position": "rad", "velocity": "rad/s", "effort": "N·m"},
    ),
    "franka_msgs/FrankaRobotState": Source(
        ("measured_joint_state",),
        "measured_joint_state.name",
        (_below("measured_joint_state", _JOINT_STATE),),
        {"position": "rad", "velocity": "rad/s", "effort": "N·m"},
    ),
    "control_msgs/JointTrajectoryControllerState": Source(
        ("actual", "feedback"), "joint_names", (_below("feedback", _POINT), _below("actual", _POINT)), {}
    ),
}
"""Types of messages that are read, by name."""


@dataclass(frozen=True)
class Kind:
    """What some messages of a channel hold alike.

    joints: their names; quantities: those that there are values of; named: whether the names are the messages' own, not
    counted by us.
    """

    joints: tuple[str, ...]
    quantities: tuple[str, ...]
    named: bool = True


@dataclass(frozen=True)
class Form:
    """Layout of some messages, and where in it the stamp and the quantities of its kind's joints lie."""

    layout: Layout
    kind: Kind
    stamp: int
    places: Mapping[str, tuple[int, str]]

    def stamps(self, rows: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Time of the header in ns of messages (M, bytes), 0 where it was not set."""
        order = ">" if self.layout.big_endian else "<"
        parts = np.ascontiguousarray(rows[:, self.stamp : self.stamp + 8]).view(f"{order}u4").astype(np.int64)
        return np.asarray(parts[:, 0] * 1_000_000_000 + parts[:, 1])

    def values(self, rows: NDArray[np.uint8], quantity: str) -> Array:
        """A quantity of the kind's joints in messages (M, bytes), (M, n)."""
        start, dtype = self.places[quantity]
        size = np.dtype(dtype).itemsize * len(self.kind.joints)
        return np.ascontiguousarray(rows[:, start : start + size]).view(dtype).astype(np.float64)


class Decoder:
    """Of the messages of one channel; raise InvalidDataError where its type's definition is missing or damaged."""

    def __init__(self, channel: Channel) -> None:
        self.channel, self.source = channel, SOURCES[channel.type]
        self.types: Types = well_known(channel.encoding)
        if channel.definition is not None and channel.definition.strip():
            try:
                self.types = self.types | parse(channel.definition, channel.type)
            except ValueError as error:
                raise invalid_data(f"definition of {channel.type}", str(error), "a message definition") from None
        if channel.type not in self.types:
            raise invalid_data(
                f"topic {channel.topic}",
                f"of type {channel.type}, without its definition",
                "a bag that holds its messages' definitions, as ROS 2 records them since Iron and in MCAP",
            )
        fields = [each.name for each in self.types[channel.type]]
        ends = [name for name in fields if name in self.source.last]
        if not ends:
            raise invalid_data(f"definition of {channel.type}", ", ".join(fields)[:200], " or ".join(self.source.last))
        self.last = ends[-1]
        self._forms: list[Form] = []

    def form(self, data: bytes, number: int) -> Form:
        """Form of the channel's message `number`, counted from 1; raise InvalidDataError."""
        for form in self._forms:
            if form.layout.fits(data):
                return form
        form = self._new(data, number)
        if len(self._forms) >= 64:  # most channels have one layout
            self._forms.pop()
        self._forms.insert(0, form)
        return form

    def _new(self, data: bytes, number: int) -> Form:
        channel = self.channel
        try:
            layout = lay_out(data, self.types, channel.type, self.last, channel.encoding)
        except ValueError as error:  # that of text which is not UTF-8, too
            raise self._wrong(number, str(error), f"a {channel.type}") from None
        numbers = layout.numbers
        ways = [(way, _counts(numbers, way)) for way in self.source.quantities]
        way, counts = max(ways, key=lambda each: ("position" in each[1], len(each[1])))
        joints = tuple(layout.texts.get(self.source.names, ()) if self.source.names else ())
        named = bool(joints)
        if not named:
            joints = tuple(f"joint{joint + 1}" for joint in range(counts.get("position", 0)))
        if len(set(joints)) < len(joints):
            raise self._wrong(number, f"with joints {', '.join(joints)[:150]}", "every joint once")
        for quantity, count in counts.items():
            if count != len(joints):
                raise self._wrong(number, f"with {count} values of {way[quantity]}", f"{len(joints)}, one a joint")
        order = ">" if layout.big_endian else "<"
        places = {each: (numbers[way[each]][0], order + _DTYPES[numbers[way[each]][2]]) for each in counts}
        return Form(layout, Kind(joints, tuple(counts), named), self._stamp(numbers, number), places)

    def _stamp(self, numbers: Mapping[str, tuple[int, int, str]], number: int) -> int:
        if "header.stamp" in numbers and numbers["header.stamp"][2] == "time":  # of ROS 1
            return numbers["header.stamp"][0]
        seconds, nanoseconds = numbers.get("header.stamp.sec"), numbers.get("header.stamp.nanosec")
        if seconds is None or seconds[1] != 1 or seconds[2] not in ("int32", "uint32"):
            raise self._wrong(number, "without a stamp", "a header with a stamp in s and ns")
        if nanoseconds != (seconds[0] + 4, 1, "uint32"):
            raise self._wrong(number, "without a stamp", "a header with a stamp in s and ns")
        return seconds[0]

    def _wrong(self, number: int, value: str, expected: str) -> InvalidDataError:
        return invalid_data(f"topic {self.channel.topic}, message {number}", value, expected)


def _counts(numbers: Mapping[str, tuple[int, int, str]], way: Mapping[str, str]) -> dict[str, int]:
    fields = {each: numbers[path] for each, path in way.items() if path in numbers}
    return {each: count for each, (_, count, kind) in fields.items() if count and kind in _DTYPES}


def choose(kinds: Sequence[Kind], counts: Sequence[int], given: tuple[str, ...] | None, topic: str) -> tuple[str, ...]:
    """Joints to read: those `given`, or of the set that matters most; raise InvalidDataError.

    kinds and counts: what the messages hold, and how many hold it. A set matters by the messages that tell of all its
    joints, times the square of their number: an arm at 30 Hz more than its gripper at 200 Hz.
    """
    numbers: dict[frozenset[str], int] = {}
    orders: dict[frozenset[str], tuple[str, ...]] = {}
    for kind, count in sorted(zip(kinds, counts, strict=True), key=lambda each: -each[1]):
        if "position" in kind.quantities:
            numbers[frozenset(kind.joints)] = numbers.get(frozenset(kind.joints), 0) + count
            orders.setdefault(frozenset(kind.joints), kind.joints)
    if not numbers:
        raise invalid_data(f"topic {topic}", "without positions", "messages that tell the position of joints")
    if given is not None:
        if any(each.issuperset(given) for each in numbers):
            return given
        known = sorted(set().union(*numbers))
        raise invalid_data("joint_names", ", ".join(given), f"joints out of {_listed(known)}, told together")

    def weight(joints: frozenset[str]) -> int:
        return len(joints) ** 2 * sum(count for other, count in numbers.items() if other >= joints)

    return orders[max(numbers, key=weight)]


def describe(
    kinds: Sequence[Kind], counts: Sequence[int], joints: tuple[str, ...], quantities: Mapping[str, int]
) -> list[str]:
    """What is to be told of the choice, in sentences. quantities: number of messages that hold each."""
    facts = []
    read = [(kind, count) for kind, count in zip(kinds, counts, strict=True) if holds(kind, joints)]
    total, kept = sum(counts), sum(count for _, count in read)
    if kept < total:
        others = {joint for kind in kinds for joint in kind.joints} - set(joints)
        also = f" (others tell of {_listed(sorted(others))})" if others else ""
        facts.append(f"{total - kept} of {total} messages do not tell of all joints and were left out{also}")
    elif others := {joint for kind, _ in read for joint in kind.joints} - set(joints):
        facts.append(f"joints {_listed(sorted(others))} were left out")
    orders = {tuple(joint for joint in kind.joints if joint in joints) for kind, _ in read}
    if len(orders) > 1:
        facts.append(f"the joints come in {len(orders)} orders: they were matched by name in every message")
    facts += [
        f"{kept - count} of {kept} messages have no {quantity}"
        for quantity, count in quantities.items()
        if 0 < count < kept
    ]
    return facts


def holds(kind: Kind, joints: tuple[str, ...]) -> bool:
    """Whether messages of a kind tell the position of all these joints."""
    return "position" in kind.quantities and set(kind.joints).issuperset(joints)


def _listed(joints: Sequence[str]) -> str:
    return ", ".join(readable(joint[:100]) for joint in joints[:20]) + (" …" if len(joints) > 20 else "")

"""Messages that tell the state of a robot's joints: which there are, and what of them is position, velocity, effort."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from service.datasets.formats.bags.container import Channel
from service.datasets.formats.bags.definitions import Types, parse, well_known
from service.datasets.formats.bags.layout import Layout, lay_out
from service.foundation.errors import InvalidDataError, invalid_data

ENCODINGS = ("cdr", "ros1")
MOST_LAYOUTS = 64
"""Layouts that are remembered of a channel; most have one."""
MOST_FIELDS = 50_000_000
"""Fields of a channel that are looked at one by one, because the layouts keep changing: about a minute of them."""
_JOINT_STATE = {"position": "position", "velocity": "velocity", "effort": "effort"}
_POINT = {
    "position": "positions",
    "velocity": "velocities",
    "acceleration": "accelerations",
    "effort": "effort",
}


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
        wanted = [name for name in fields if name in self.source.last]
        if not wanted:
            raise invalid_data(f"definition of {channel.type}", ", ".join(fields)[:200], " or ".join(self.source.last))
        self.last = wanted[-1]
        self._forms: list[Form] = []
        self._fields = 0

    def form(self, data: bytes, number: int) -> Form:
        """Form of the channel's message `number`, counted from 1; raise InvalidDataError."""
        for form in self._forms:
            if form.layout.fits(data):
                return form
        form = self._new(data, number)
        if len(self._forms) >= MOST_LAYOUTS:
            self._forms.pop()
        self._forms.insert(0, form)
        return form

    def _new(self, data: bytes, number: int) -> Form:
        channel = self.channel
        try:
            layout = lay_out(data, self.types, channel.type, self.last, channel.encoding)
        except ValueError as error:  # that of text which is not UTF-8, too
            raise self._wrong(number, str(error), f"a {channel.type}") from None
        self._fields += layout.fields
        if self._fields > MOST_FIELDS:
            raise self._wrong(number, "yet another layout", "messages that are alike")
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
        if seconds is None or seconds[1:] not in _SECONDS or nanoseconds != (seconds[0] + 4, 1, "uint32"):
            raise self._wrong(number, "without a stamp", "a header with a stamp in s and ns")
        return seconds[0]

    def _wrong(self, number: int, found: str, expected: str) -> InvalidDataError:
        return invalid_data(f"topic {self.channel.topic}, message {number}", found, expected)


def _counts(numbers: Mapping[str, tuple[int, int, str]], way: Mapping[str, str]) -> dict[str, int]:
    found = {each: numbers[path] for each, path in way.items() if path in numbers}
    return {each: count for each, (_, count, kind) in found.items() if count and kind in _DTYPES}


_SECONDS = ((1, "int32"), (1, "uint32"))
_DTYPES = {
    "float32": "f4",
    "float64": "f8",
    **{f"{sign}int{bits}": f"{sign[:1] or 'i'}{bits // 8}" for sign in ("", "u") for bits in (8, 16, 32, 64)},
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
}
"""NumPy's types of numbers in messages."""

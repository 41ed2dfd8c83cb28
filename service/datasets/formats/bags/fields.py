"""The fields of a message that hold numbers of each joint: found in any message type from the names of its fields."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np

from service.datasets.formats.bags.containers import Topic
from service.datasets.mapping.recognition import NameReading, Rank, interpret_name
from service.datasets.mapping.vocabulary import COMMANDED, split_words

MAX_DEPTH = 8
MAX_FIELDS = 2000
_SI = {"q": "rad", "dq": "rad/s", "ddq": "rad/s^2", "tau": "N·m"}
_DEGREES = _SI | {"q": "deg", "dq": "deg/s"}
UNITS = {"franka_msgs": _SI, "iiwa_msgs": _SI, "lbr_fri_msgs": _SI, "lbr_fri_idl": _SI, "kortex_driver": _DEGREES}
"""Units by package and quantity, for message types that define them. Others follow no rule that drivers keep."""
_NAME_FIELDS = ("name", "names", "joint_name", "joint_names")
_STAMPS = ("header.stamp.", "stamp.", "timestamp.", "time_stamp_")
_SECONDS, _NANOSECONDS = ("sec", "secs", "seconds"), ("nanosec", "nsec", "nsecs", "nanos", "nanoseconds", "nano_sec")
_NUMBERED = re.compile(r"(.*?)(\d+)")
Getter = Callable[[Any], Any]


@dataclass(frozen=True)
class JointField:
    """A field, or equal fields of the parts of a list, with a number of each joint."""

    path: str
    """Names of fields, joined by dots."""
    get: Getter
    """Returns the numbers of a message."""
    column: str = ""
    """Name of its columns: a word for the quantity, as in `position` or `commanded_torque`."""


@dataclass(frozen=True)
class JointFields:
    """The fields of a topic's messages that are read."""

    quantities: dict[str, JointField]
    """By quantity: q, dq, ddq or tau."""
    names: Getter | None
    """Returns the joint names of a message; None if the messages have none."""
    stamp: Getter | None
    """Returns the stamp of a message, ns; None if the messages have none."""
    units: dict[str, str]
    """Units by quantity, if the type defines them."""
    commanded: bool
    """Whether positions or torques are commanded ones."""


def find_fields(topic: Topic, messages: Sequence[Any]) -> JointFields | None:
    """Return the fields of joints in messages of a topic; None if there are none."""
    arrays: dict[str, JointField] = {}
    names: dict[str, Getter] = {}
    for message in messages:
        for field, what in _walk(message, "", lambda each: each, 0):
            if what == "names":
                names.setdefault(field.path.rpartition(".")[0], field.get)
            elif len(field.get(message)):
                arrays.setdefault(field.path, field)
        if len(arrays) > MAX_FIELDS:
            return None
    by_topic = any(word.text in COMMANDED for word in split_words(topic.name))
    readings = {path: reading for path in arrays if (reading := _interpret(topic, path)) is not None}
    chosen = _choose(readings)
    if not {"q", "dq", "tau"} & chosen.keys():
        return None
    quantities = {}
    for quantity, path in chosen.items():
        commanded = by_topic or readings[path].rank == Rank.COMMANDED
        kind = readings[path].kind
        quantities[quantity] = replace(arrays[path], column=f"commanded_{kind}" if commanded else kind)
    main = next(chosen[each] for each in ("q", "tau", "dq") if each in chosen)
    parents = [main.rpartition(".")[0]]
    while parents[-1]:
        parents.append(parents[-1].rpartition(".")[0])
    package = topic.type.partition("/")[0]
    return JointFields(
        quantities,
        next((names[each] for each in parents if each in names), None),
        _find_stamp(messages[0]),
        UNITS.get(package, {}),
        any(each.column.startswith("commanded") for each in quantities.values()),
    )


def _interpret(topic: Topic, path: str) -> NameReading | None:
    """Return what a field means by its path; a field such as `data` means what its topic's name says."""
    last = path.rpartition(".")[2]
    for name in (path, f"{topic.name.strip('/')}.{last}" if last in ("data", "values", "value") else ""):
        if readings := interpret_name(name):
            return readings[0]
    return None


def _choose(readings: dict[str, NameReading]) -> dict[str, str]:
    """Return the path of each quantity: measured before commanded, and from the part that holds most quantities."""
    of_part: dict[str, dict[str, str]] = {}
    for path in sorted(readings, key=lambda each: (readings[each].rank, readings[each].kind == "angle", len(each))):
        reading, part = readings[path], path.rpartition(".")[0]
        if reading.rank == Rank.COMMANDED and reading.quantity in ("dq", "ddq"):
            continue
        of_part.setdefault(part, {}).setdefault(reading.quantity, path)

    def merit(part: str) -> tuple[Any, ...]:
        found = of_part[part]
        ranks = [readings[found[each]].rank for each in ("q", "tau") if each in found]
        return {"q", "tau"} <= found.keys(), bool(ranks), -max(ranks, default=Rank.PLAIN), len(found), -len(part)

    order = sorted(of_part, key=merit, reverse=True)
    chosen: dict[str, str] = {}
    for part in order:
        for quantity, path in of_part[part].items():
            if part == order[0] or (quantity == "tau" and "output" not in path):
                chosen.setdefault(quantity, path)
    return chosen


def _walk(value: Any, path: str, get: Getter, depth: int) -> Iterator[tuple[JointField, str]]:
    """Yield the lists of numbers and the lists of names in a message; numbered fields form a list."""
    if depth > MAX_DEPTH:
        return
    numbered: dict[str, list[str]] = {}
    for name in _field_names(value):
        item, place = getattr(value, name), f"{path}.{name}" if path else name
        here = _then(get, name)
        if isinstance(item, bool | int | float):
            if match := _NUMBERED.fullmatch(name):
                numbered.setdefault(match[1], []).append(name)
        elif isinstance(item, str | bytes):
            continue
        elif _is_sequence(item):
            yield from _walk_list(item, place, here)
        else:
            yield from _walk(item, place, here, depth + 1)
    for found in numbered.values():
        if len(found) > 1:
            yield JointField(f"{path}.{found[0]}" if path else found[0], _members(get, found)), "numbers"


def _walk_list(item: Any, path: str, get: Getter) -> Iterator[tuple[JointField, str]]:
    first: Any = item[0] if len(item) else None
    if isinstance(first, bool | int | float | np.number) or (first is None and not isinstance(item, list)):
        yield JointField(path, get), "numbers"
    elif isinstance(first, str) and path.rpartition(".")[2] in _NAME_FIELDS:
        yield JointField(path, get), "names"
    elif hasattr(first, "interface_names") and hasattr(first, "values"):  # control_msgs/DynamicJointState
        for name in first.interface_names:
            yield JointField(f"{path}.{name}", _interface(get, name)), "numbers"
    else:
        for name in _field_names(first):
            member = getattr(first, name)
            if isinstance(member, int | float):
                yield JointField(f"{path}.{name}", _of_each(get, name)), "numbers"
            elif isinstance(member, str) and name in _NAME_FIELDS:
                yield JointField(f"{path}.{name}", _of_each(get, name)), "names"


def _field_names(value: Any) -> list[str]:
    if is_dataclass(value):
        return [each.name for each in fields(value)]
    if hasattr(value, "DESCRIPTOR"):  # Protobuf
        return [each.name for each in value.DESCRIPTOR.fields]
    return list(vars(value)) if hasattr(value, "__dict__") else []


def _is_sequence(value: Any) -> bool:
    return hasattr(value, "__len__") and hasattr(value, "__getitem__")


def _then(get: Getter, name: str) -> Getter:
    return lambda message: getattr(get(message), name)


def _members(get: Getter, names: Sequence[str]) -> Getter:
    each = attrgetter(*names)
    return lambda message: each(get(message))


def _of_each(get: Getter, name: str) -> Getter:
    each = attrgetter(name)
    return lambda message: [each(item) for item in get(message)]


def _interface(get: Getter, name: str) -> Getter:
    def values(message: Any) -> list[float]:
        return [
            float(item.values[item.interface_names.index(name)]) if name in item.interface_names else np.nan
            for item in get(message)
        ]

    return values


def _find_stamp(message: Any) -> Getter | None:
    """Return the function that reads the stamp of messages like this one, ns."""
    for names in itertools.product(_STAMPS, _SECONDS, _NANOSECONDS):
        seconds, nanoseconds = names[0] + names[1], names[0] + names[2]
        if _has_number(message, seconds) and _has_number(message, nanoseconds):
            return _stamp(seconds, nanoseconds)
    return None


def _has_number(message: Any, path: str) -> bool:
    try:
        return isinstance(attrgetter(path)(message), int | float)
    except AttributeError:
        return False


def _stamp(second: str, nano: str) -> Getter:
    both = attrgetter(second, nano)

    def stamp(message: Any) -> int:
        seconds, nanoseconds = both(message)
        return int(seconds) * 1_000_000_000 + int(nanoseconds)

    return stamp

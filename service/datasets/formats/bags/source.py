"""One topic of a bag: its messages are collected, then arranged as a row of numbers per message."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from service.datasets.formats.bags.containers import Topic
from service.datasets.formats.bags.decoding import Decoder
from service.datasets.formats.bags.fields import JointFields
from service.datasets.formats.bags.joints import MessageKind, choose_joints, describe_choice, has_joints
from service.datasets.formats.table import first_line, unreadable
from service.foundation.errors import InvalidDataError, invalid_data, readable
from service.foundation.settings import Settings
from service.foundation.text import counted

MAX_KINDS = 1000
"""Max number of message kinds in a topic."""
NS = 1_000_000_000


@dataclass(frozen=True)
class Samples:
    """The numbers of a topic: values (N, n) by quantity, NaN where a message has none."""

    times: NDArray[np.int64]
    """Header stamps or times of reception, ns, (N,)."""
    received: NDArray[np.int64]
    """Times of reception, ns, (N,); they may not rise."""
    stamped: bool
    """Whether `times` are header stamps."""
    joints: tuple[str, ...]
    values: Mapping[str, Array]
    facts: tuple[str, ...]


@dataclass(eq=False)
class Source:
    """A topic that is read, and its messages so far."""

    topic: Topic
    decode: Decoder
    fields: JointFields
    quantities: tuple[str, ...]
    """The quantities that are read; a message without the first one is not read."""
    kinds: list[MessageKind] = field(default_factory=list)
    indices: dict[tuple[Any, ...], int] = field(default_factory=dict)
    """Index of a kind by the joint names and the number of values of each quantity."""
    numbers: list[array[float]] = field(default_factory=list)
    """Numbers of the messages of each kind, one message after the other."""
    kind: array[int] = field(default_factory=lambda: array("i"))
    stamps: array[int] = field(default_factory=lambda: array("q"))
    received: array[int] = field(default_factory=lambda: array("q"))

    def collect(self, received: int, data: bytes, settings: Settings) -> None:
        """Add a message; raise InvalidDataError. received: ns."""
        if len(self.kind) >= settings.max_samples:
            raise self.error(f"more than {settings.max_samples} messages", f"at most {settings.max_samples}")
        try:
            message = self.decode(data)
            values = [self.fields.quantities[each].get(message) for each in self.quantities]
            names = tuple(self.fields.names(message)) if self.fields.names else ()
            self.stamps.append(self.fields.stamp(message) if self.fields.stamp else 0)
            self.received.append(received)
            form = (names, *map(len, values))
            index = self._index_of(form)
            for each in values:
                if self.kinds[index].quantities:
                    self.numbers[index].frombytes(np.asarray(each, np.float64).tobytes())
            self.kind.append(index)
        except (InvalidDataError, MemoryError):
            raise
        except Exception as error:  # of the decoders, for damaged messages
            raise unreadable(self._message(), first_line(error), f"a {self.topic.type}") from None

    def _index_of(self, form: tuple[Any, ...]) -> int:
        if form not in self.indices:
            self.indices[form] = len(self.kinds)
            self.kinds.append(self._kind(*form))
            self.numbers.append(array("d"))
            if len(self.kinds) > MAX_KINDS:
                raise self.error(f"more than {MAX_KINDS} sets of joints", f"at most {MAX_KINDS}")
        return self.indices[form]

    def _kind(self, names: tuple[str, ...], *counts: int) -> MessageKind:
        joints = names or tuple(f"joint{joint + 1}" for joint in range(counts[0]))
        if len(set(joints)) < len(joints):
            raise invalid_data(self._message(), f"a state of joints {', '.join(joints)[:150]}", "each joint only once")
        held = tuple(each for each, count in zip(self.quantities, counts, strict=True) if count)
        for quantity, count in zip(self.quantities, counts, strict=True):
            if count not in (0, len(joints)):
                value = f"a state with {count} values of {self.fields.quantities[quantity].column}"
                raise invalid_data(self._message(), value, f"{len(joints)}, one per joint")
        return MessageKind(joints, held if self.quantities[0] in held else (), bool(names))

    def arrange(self, given: tuple[str, ...] | None, settings: Settings) -> Samples:
        """Return the numbers of the joints: those `given`, or those of most messages; raise InvalidDataError."""
        if not self.kind:
            raise self.error("no messages", "at least one")
        kinds, kind = self.kinds, np.array(self.kind)
        counts = np.bincount(kind, minlength=len(kinds)).tolist()
        named = any(each.named for each in kinds)
        joints = names = choose_joints(kinds, counts, given if named else None, self.topic.name)
        if given is not None and not named:
            if len(given) != len(joints):
                raise invalid_data("joint_names", ", ".join(given), f"{len(joints)} names, one per joint")
            names = given
        if len(joints) > settings.max_joints:
            raise self.error(f"{len(joints)} joints", f"at most {settings.max_joints}")
        kept = np.array([has_joints(each, joints) for each in kinds])[kind]
        values = {each: np.full((len(kind), len(joints)), np.nan) for each in self.quantities}
        holding = Counter[str]()
        for index, each in enumerate(kinds):
            if not has_joints(each, joints):
                continue
            block = np.frombuffer(self.numbers[index]).reshape(-1, len(each.quantities), len(each.joints))
            order = [each.joints.index(joint) for joint in joints]
            for place, quantity in enumerate(each.quantities):
                values[quantity][kind == index] = block[:, place, order]
                holding[quantity] += len(block)
        stamps, received = np.array(self.stamps)[kept], np.array(self.received)[kept]
        use_stamps, times_of = _choose_clock(stamps, received, self.fields.stamp is not None)
        columns = {each: self.fields.quantities[each].column for each in self.quantities}
        paths = {each: self.fields.quantities[each].path for each in self.quantities}
        facts = [f"topic {self.topic.name}: {counted(len(kind), 'message')} of type {self.topic.type}"]
        if paths != columns:
            facts[0] += ", fields " + ", ".join(paths.values())
        facts += describe_choice(kinds, counts, joints, {columns[each]: holding[each] for each in self.quantities})
        facts.append(f"times are {times_of}")
        return Samples(
            stamps if use_stamps else received,
            received,
            use_stamps,
            names,
            {each: values[each][kept] for each in self.quantities if holding[each]},
            tuple(facts),
        )

    def error(self, value: str, expected: str) -> InvalidDataError:
        """Return the error for a topic that cannot be read."""
        name = f"topic {self.topic.name}"
        return invalid_data(name, value, expected, f"{readable(name[:200])} has {value}, expected {expected}")

    def _message(self) -> str:
        return f"topic {self.topic.name}, message {len(self.kind) + 1}"


def _choose_clock(stamps: NDArray[np.int64], received: NDArray[np.int64], stamped: bool) -> tuple[bool, str]:
    """Return whether header stamps are used as times, and words for the report on the times."""
    if not received.any():  # of `ros2 topic echo`
        return stamped and bool((np.diff(stamps) >= 0).all()), "header stamps" if stamped else "not in the messages"
    if not stamped:
        return False, "reception times because the messages have no stamps"
    steps, unset = np.diff(stamps), int((stamps == 0).sum())
    # stamps of a simulation start at 0 and stay below three years
    if unset and not 0 < stamps.max() < 10**8 * NS:
        return False, f"reception times because {unset} of {len(stamps)} header stamps are not set"
    if back := int((steps < 0).sum()):
        first = int(np.argmax(steps < 0)) + 2
        return False, f"reception times because header stamps go back {counted(back, 'time')}, first in row {first}"
    if len(stamps) > 1 and 2 * int((steps > 0).sum()) < len(steps):
        return False, "reception times because most header stamps repeat the one before"
    return True, "header stamps"

"""Reading a bag of any kind as a table.

The topic with joint states is chosen. Its messages are read twice: first to find what they hold, then for the numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from service.datasets.formats.bags import files
from service.datasets.formats.bags.container import Bag, Channel, JoinedBags
from service.datasets.formats.bags.states import (
    ENCODINGS,
    MAX_KINDS,
    STATE_TYPES,
    Decoder,
    MessageForm,
    MessageKind,
    choose_joints,
    describe_choice,
    has_joints,
)
from service.datasets.formats.table import BLOCK_ROWS, Table, clean_names
from service.datasets.formats.zips import unpack_bag
from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError, invalid_data, invalid_request, readable
from service.foundation.settings import Settings
from service.foundation.text import counted

BagKind = Literal["rosbag1", "rosbag2", "mcap"]
KINDS = {"rosbag1": "a ROS 1 bag", "rosbag2": "a ROS 2 bag: a .db3 file or a zip of its folder", "mcap": "an MCAP file"}
QUANTITIES = ("position", "velocity", "acceleration", "effort")
BATCH_BYTES = 4 * 1024 * 1024
"""Max bytes of messages in a batch. Their copies and the block need several times this."""
NS = 1_000_000_000


@dataclass
class _Batch:
    """Consecutive messages: reception times in ns, and by form the row numbers and bytes."""

    received: list[int] = field(default_factory=list)
    rows: dict[int, tuple[MessageForm, list[int], list[bytes]]] = field(default_factory=dict)

    def groups(self) -> Iterator[tuple[MessageForm, NDArray[np.int64], NDArray[np.uint8]]]:
        """Yield the form, row numbers (M,) and data (M, bytes) of the messages of each form."""
        for form, rows, data in self.rows.values():
            yield form, np.array(rows), np.frombuffer(b"".join(data), np.uint8).reshape(len(rows), -1)


@dataclass
class _Survey:
    """The kinds of messages, and for each message the index of its kind, its stamp and its reception time in ns."""

    kinds: list[MessageKind]
    kind: NDArray[np.int32]
    stamps: NDArray[np.int64]
    received: NDArray[np.int64]


def read_channel(bag: Bag, channel: Channel, joint_names: tuple[str, ...] | None, settings: Settings) -> Table:
    """Return the table of a channel; raise InvalidDataError. joint_names: joints to read; None chooses them."""
    survey = _survey(bag, channel, settings)
    counts = np.bincount(survey.kind, minlength=len(survey.kinds)).tolist()
    named = any(kind.named for kind in survey.kinds)
    joints = names = choose_joints(survey.kinds, counts, joint_names if named else None, channel.topic)
    if joint_names is not None and not named:
        if len(joint_names) != len(joints):
            raise invalid_data("joint_names", ", ".join(joint_names), f"{len(joints)} names, one per joint")
        names = joint_names
    if len(joints) > settings.max_joints:
        raise _topic_error(channel, f"{len(joints)} joints", f"at most {settings.max_joints}")
    kept_kinds = np.array([has_joints(kind, joints) for kind in survey.kinds])
    kept = kept_kinds[survey.kind]
    holding = {
        each: sum(
            c for k, c in zip(survey.kinds, counts, strict=True) if has_joints(k, joints) and each in k.quantities
        )
        for each in QUANTITIES
    }
    quantities = tuple(each for each in QUANTITIES if holding[each])
    if "effort" not in quantities:
        raise _topic_error(channel, "no effort: it is empty in all messages", "the torque of each joint")
    use_stamps, times_of = _choose_clock(survey.stamps[kept], survey.received[kept])
    times = survey.stamps if use_stamps else survey.received
    start = int(times[np.argmax(kept)])
    facts = [
        *bag.facts,
        f"topic {channel.topic}: {counted(len(kept), 'message')} of type {channel.type}",
        *describe_choice(survey.kinds, counts, joints, holding),
        f"times are {times_of}, counted from {start // NS}.{start % NS:09d} s",
    ]
    units = Decoder(channel).source.units
    return Table(
        names=clean_names(("t", *(f"{joint}/{quantity}" for quantity in quantities for joint in names))),
        blocks=_blocks(bag, channel, joints, quantities, use_stamps, start),
        joint_names=names,
        units={"t": "s"}
        | {f"{joint}/{quantity}": units[quantity] for quantity in quantities if quantity in units for joint in names},
        facts=facts,
    )


def _batches(bag: Bag, channel: Channel) -> Iterator[_Batch]:
    decoder = Decoder(channel)
    batch, size = _Batch(), 0
    for number, (time, data) in enumerate(bag.messages(channel), 1):
        form = decoder.find_form(data, number)
        _, rows, known = batch.rows.setdefault(id(form), (form, [], []))
        rows.append(len(batch.received))
        known.append(data)
        batch.received.append(time)
        size += len(data)
        if len(batch.received) == BLOCK_ROWS or size > BATCH_BYTES:
            yield batch
            batch, size = _Batch(), 0
    if batch.received:
        yield batch


def _survey(bag: Bag, channel: Channel, settings: Settings) -> _Survey:
    numbers: dict[MessageKind, int] = {}
    parts: list[tuple[NDArray[np.int32], NDArray[np.int64], NDArray[np.int64]]] = []
    total = 0
    for batch in _batches(bag, channel):
        kind, stamps = np.zeros(len(batch.received), np.int32), np.zeros(len(batch.received), np.int64)
        for form, rows, data in batch.groups():
            kind[rows] = numbers.setdefault(form.kind, len(numbers))
            stamps[rows] = form.stamps(data)
        parts.append((kind, stamps, np.array(batch.received, np.int64)))
        total += len(kind)
        if total > settings.max_samples:
            raise _topic_error(channel, f"more than {settings.max_samples} messages", f"at most {settings.max_samples}")
        if len(numbers) > MAX_KINDS:
            raise _topic_error(channel, f"more than {MAX_KINDS} sets of joints", f"at most {MAX_KINDS}")
    if not parts:
        raise _topic_error(channel, "no messages", "at least one")
    return _Survey(list(numbers), *(np.concatenate(column) for column in zip(*parts, strict=True)))


def _choose_clock(stamps: NDArray[np.int64], received: NDArray[np.int64]) -> tuple[bool, str]:
    """Return whether header stamps are used as times, and words for the report on the times."""
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


def _blocks(
    bag: Bag, channel: Channel, joints: tuple[str, ...], quantities: tuple[str, ...], use_stamps: bool, start: int
) -> Iterator[Array]:
    n = len(joints)
    for batch in _batches(bag, channel):
        block = np.full((len(batch.received), 1 + n * len(quantities)), np.nan)
        kept = np.zeros(len(block), bool)
        received = np.array(batch.received, np.int64)
        for form, rows, data in batch.groups():
            if not has_joints(form.kind, joints):
                continue
            kept[rows] = True
            # subtract integers: seconds since 1970 as floats have a resolution of 0.2 µs
            block[rows, 0] = ((form.stamps(data) if use_stamps else received[rows]) - start) / NS
            order = [form.kind.joints.index(joint) for joint in joints]
            for index, quantity in enumerate(quantities):
                if quantity in form.kind.quantities:
                    block[rows, 1 + index * n : 1 + (index + 1) * n] = form.values(data, quantity)[:, order]
        if kept.any():
            yield block[kept]


@contextmanager
def open_bag(path: Path, kind: BagKind, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open the joint states of a bag as a table with columns `t` in s and `<joint>/position`, `/velocity`, `/effort`.

    kind: `rosbag2` is a sqlite3 file, or the zip of a folder of sqlite3 or MCAP files. Raise InvalidDataError,
    InvalidRequestError if the topic is wrong, or TooLargeError.
    """
    with ExitStack() as stack:
        with path.open("rb") as file:
            zipped = file.read(4) == b"PK\x03\x04"
        if zipped:
            files = stack.enter_context(unpack_bag(path, settings))
            bag: Bag = JoinedBags(path, [_open(each, "rosbag2", settings) for each in files], settings)
        else:
            bag = _open(path, kind, settings)
        channel = _choose_channel(bag.channels(), options.topic, bag)
        yield read_channel(bag, channel, options.joint_names, settings)


def _open(path: Path, kind: str, settings: Settings) -> Bag:
    with path.open("rb") as file:
        start = file.read(16)
    if start.startswith(files.MCAP_MAGIC):
        return files.Mcap(path, settings)
    if start.startswith(files.ROSBAG1_MAGIC):
        return files.Rosbag1(path, settings)
    if start.startswith(files.SQLITE_MAGIC):
        return files.SqliteBag(path, settings)
    if not start:
        raise invalid_data("file", "empty", KINDS[kind])
    raise invalid_data("file", f"not a bag (it begins with {start!r})", KINDS[kind])


def _choose_channel(channels: dict[Channel, int], topic: str | None, bag: Bag) -> Channel:
    """Return the channel to read. channels: number of messages of each."""
    if not channels:
        message = "; ".join(["The bag has no messages", *bag.facts])
        raise invalid_data("file", "a bag without messages", "joint states", message)
    known = {each: count for each, count in channels.items() if each.type in STATE_TYPES and each.encoding in ENCODINGS}
    # messages of several publishers of a topic are read together
    by_name = {(each.topic, each.type): each for each in reversed(known)}
    if topic is not None:
        candidates = [each for each in by_name.values() if each.topic == topic]
        if not candidates and any(each.topic == topic for each in channels):
            other = next(each for each in channels if each.topic == topic)
            raise invalid_request("topic", f"{topic} of type {other.type} ({other.encoding})", _expected_topic())
        if not candidates:
            raise invalid_request("topic", topic, f"one of {_listed(known or channels)}")
    else:
        candidates = list(by_name.values())
        if not candidates:
            raise invalid_data("file", f"a bag of the topics {_listed(channels)}", _expected_topic())
    if len(candidates) > 1:
        raise _ambiguous(known)
    return candidates[0]


def _ambiguous(known: dict[Channel, int]) -> InvalidDataError:
    listed = _listed(known)
    return invalid_data("topic", "missing", f"one of {listed}", f"Set `topic`, because the bag has several: {listed}")


def _topic_error(channel: Channel, value: str, expected: str) -> InvalidDataError:
    topic = f"topic {channel.topic}"
    return invalid_data(topic, value, expected, f"{readable(topic[:200])} has {value}, expected {expected}")


def _expected_topic() -> str:
    return f"a topic of type {', '.join(STATE_TYPES)} in CDR or ROS 1 encoding"


def _listed(channels: dict[Channel, int]) -> str:
    counts: dict[tuple[str, str], int] = {}
    for each, count in channels.items():
        counts[each.topic, each.type] = counts.get((each.topic, each.type), 0) + count
    listed = [
        f"{readable(topic[:100])} ({readable(name[:100])}, {count} messages)"
        for (topic, name), count in list(counts.items())[:20]
    ]
    return ", ".join(listed) + (f" and {len(counts) - 20} more" if len(counts) > 20 else "")

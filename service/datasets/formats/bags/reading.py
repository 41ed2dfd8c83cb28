"""A bag of any kind as a table: the topic that tells the joints' state is chosen, and its messages are read twice, once
to see what they hold, once more for the numbers."""

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
    MOST_KINDS,
    SOURCES,
    Decoder,
    Form,
    Kind,
    choose,
    describe,
    holds,
)
from service.datasets.formats.table import BLOCK_ROWS, Table, checked_names
from service.datasets.formats.zips import unpacked_bag
from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError, invalid_data, invalid_request, readable
from service.foundation.settings import Settings
from service.foundation.text import counted

BagKind = Literal["rosbag1", "rosbag2", "mcap"]
KINDS = {"rosbag1": "a rosbag of ROS 1", "rosbag2": "a rosbag2: a .db3 file, or a zip of its folder", "mcap": "an MCAP"}
QUANTITIES = ("position", "velocity", "acceleration", "effort")
BATCH_BYTES = 4 * 1024 * 1024
"""Messages that are taken together; their copies and their block take several times that."""
NS = 1_000_000_000


@dataclass
class _Batch:
    """Some messages, in order: times of reception in ns, and the rows of each form with their bytes."""

    received: list[int] = field(default_factory=list)
    rows: dict[int, tuple[Form, list[int], list[bytes]]] = field(default_factory=dict)

    def groups(self) -> Iterator[tuple[Form, NDArray[np.int64], NDArray[np.uint8]]]:
        """Form, row numbers (M,) and data (M, bytes) of the messages of each form."""
        for form, rows, data in self.rows.values():
            yield form, np.array(rows), np.frombuffer(b"".join(data), np.uint8).reshape(len(rows), -1)


@dataclass
class _Survey:
    """What the messages hold: kinds, and by message the number of its kind, its stamp and time of reception in ns."""

    kinds: list[Kind]
    kind: NDArray[np.int32]
    stamps: NDArray[np.int64]
    received: NDArray[np.int64]


def read_channel(bag: Bag, channel: Channel, joint_names: tuple[str, ...] | None, settings: Settings) -> Table:
    """The table of a channel; raise InvalidDataError. joint_names: of the joints to read, None finds out."""
    survey = _survey(bag, channel, settings)
    counts = np.bincount(survey.kind, minlength=len(survey.kinds)).tolist()
    named = any(kind.named for kind in survey.kinds)
    joints = names = choose(survey.kinds, counts, joint_names if named else None, channel.topic)
    if joint_names is not None and not named:
        if len(joint_names) != len(joints):
            raise invalid_data("joint_names", ", ".join(joint_names), f"{len(joints)} names, one a joint")
        names = joint_names
    if len(joints) > settings.max_joints:
        raise invalid_data(f"topic {channel.topic}", f"of {len(joints)} joints", f"at most {settings.max_joints}")
    kept_kinds = np.array([holds(kind, joints) for kind in survey.kinds])
    kept = kept_kinds[survey.kind]
    holding = {
        each: sum(c for k, c in zip(survey.kinds, counts, strict=True) if holds(k, joints) and each in k.quantities)
        for each in QUANTITIES
    }
    quantities = tuple(each for each in QUANTITIES if holding[each])
    use_stamps, why = _clock(survey.stamps[kept], survey.received[kept])
    times = survey.stamps if use_stamps else survey.received
    start = int(times[np.argmax(kept)])
    facts = [
        *bag.facts,
        f"topic {channel.topic}: {counted(len(kept), 'message')} of type {channel.type}",
        *describe(survey.kinds, counts, joints, holding),
        f"times are {why}, counted from {start // NS}.{start % NS:09d} s",
    ]
    units = Decoder(channel).source.units
    return Table(
        names=checked_names(("t", *(f"{joint}/{quantity}" for quantity in quantities for joint in names))),
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
        form = decoder.form(data, number)
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
    numbers: dict[Kind, int] = {}
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
            raise invalid_data(f"topic {channel.topic}", f"of more than {settings.max_samples} messages", "fewer")
        if len(numbers) > MOST_KINDS:
            raise invalid_data(f"topic {channel.topic}", f"of more than {MOST_KINDS} sets of joints", "fewer")
    if not parts:
        raise invalid_data(f"topic {channel.topic}", "without messages", "messages")
    return _Survey(list(numbers), *(np.concatenate(column) for column in zip(*parts, strict=True)))


def _clock(stamps: NDArray[np.int64], received: NDArray[np.int64]) -> tuple[bool, str]:
    """Whether the headers' stamps serve as times, and what to say about the times."""
    steps, unset = np.diff(stamps), int((stamps == 0).sum())
    # stamps of a simulation's clock, which begins at 0, stay below three years
    if unset and not 0 < stamps.max() < 10**8 * NS:
        return False, f"those of reception, as {unset} of {len(stamps)} header stamps are not set"
    if back := int((steps < 0).sum()):
        first = int(np.argmax(steps < 0)) + 2
        return False, f"those of reception, as the header stamps go back {back} times, first in row {first}"
    if len(stamps) > 1 and 2 * int((steps > 0).sum()) < len(steps):
        return False, "those of reception, as most header stamps repeat the one before"
    return True, "those of the headers"


def _blocks(
    bag: Bag, channel: Channel, joints: tuple[str, ...], quantities: tuple[str, ...], use_stamps: bool, start: int
) -> Iterator[Array]:
    n = len(joints)
    for batch in _batches(bag, channel):
        block = np.full((len(batch.received), 1 + n * len(quantities)), np.nan)
        kept = np.zeros(len(block), bool)
        received = np.array(batch.received, np.int64)
        for form, rows, data in batch.groups():
            if not holds(form.kind, joints):
                continue
            kept[rows] = True
            # whole nanoseconds are subtracted: as a float, seconds since 1970 are 0.2 µs coarse
            block[rows, 0] = ((form.stamps(data) if use_stamps else received[rows]) - start) / NS
            order = [form.kind.joints.index(joint) for joint in joints]
            for index, quantity in enumerate(quantities):
                if quantity in form.kind.quantities:
                    block[rows, 1 + index * n : 1 + (index + 1) * n] = form.values(data, quantity)[:, order]
        if kept.any():
            yield block[kept]


@contextmanager
def open_bag(path: Path, kind: BagKind, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """The joints' states in a bag, as a table with columns `t` in s and `<joint>/position`, `/velocity`, `/effort`.

    kind: `rosbag2` is an sqlite3 file or the zip of a folder, of sqlite3 or MCAP files. Raise InvalidDataError,
    InvalidRequestError where the topic is not clear, or TooLargeError.
    """
    with ExitStack() as stack:
        with path.open("rb") as file:
            zipped = file.read(4) == b"PK\x03\x04"
        if zipped:
            files = stack.enter_context(unpacked_bag(path, settings))
            bag: Bag = JoinedBags(path, [_open(each, "rosbag2", settings) for each in files], settings)
        else:
            bag = _open(path, kind, settings)
        channel = _choose(bag.channels(), options.topic, bag)
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
    raise invalid_data("file", f"no bag: it begins with {start!r}", KINDS[kind])


def _choose(channels: dict[Channel, int], topic: str | None, bag: Bag) -> Channel:
    """The channel to read; the bag's messages tell which there are."""
    if not channels:
        raise invalid_data("file", "; ".join(["a bag without messages", *bag.facts]), "joint states")
    known = {each: count for each, count in channels.items() if each.type in SOURCES and each.encoding in ENCODINGS}
    # several publishers of one topic are one recording
    by_name = {(each.topic, each.type): each for each in reversed(known)}
    if topic is not None:
        candidates = [each for each in by_name.values() if each.topic == topic]
        if not candidates and any(each.topic == topic for each in channels):
            other = next(each for each in channels if each.topic == topic)
            raise invalid_request("topic", f"{topic} of type {other.type} ({other.encoding})", _types())
        if not candidates:
            raise invalid_request("topic", topic, f"one of {_listed(known or channels)}")
    else:
        candidates = list(by_name.values())
        if not candidates:
            raise invalid_data("file", f"a bag of {_listed(channels)}", f"a topic of {_types()}")
    if len(candidates) > 1:
        raise _ambiguous(known)
    return candidates[0]


def _ambiguous(known: dict[Channel, int]) -> InvalidDataError:
    return invalid_data("topic", "not given", f"the option topic, one of {_listed(known)}")


def _types() -> str:
    return f"type {', '.join(SOURCES)}, as CDR or of ROS 1"


def _listed(channels: dict[Channel, int]) -> str:
    counts: dict[tuple[str, str], int] = {}
    for each, count in channels.items():
        counts[each.topic, each.type] = counts.get((each.topic, each.type), 0) + count
    listed = [
        f"{readable(topic[:100])} ({readable(name[:100])}, {count} messages)"
        for (topic, name), count in list(counts.items())[:20]
    ]
    return ", ".join(listed) + (f" and {len(counts) - 20} more" if len(counts) > 20 else "")

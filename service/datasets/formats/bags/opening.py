"""Opening a bag of any kind, and choosing the topic that tells the joints' state."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Literal

from service.datasets.formats.bags import mcap, rosbag1, sqlite
from service.datasets.formats.bags.archive import unpacked
from service.datasets.formats.bags.container import Bag, Channel, JoinedBags
from service.datasets.formats.bags.reading import read_channel
from service.datasets.formats.bags.states import ENCODINGS, SOURCES
from service.datasets.formats.table import Table
from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError, invalid_data, invalid_request, readable
from service.foundation.settings import Settings

BagKind = Literal["rosbag1", "rosbag2", "mcap"]
KINDS = {"rosbag1": "a rosbag of ROS 1", "rosbag2": "a rosbag2: a .db3 file, or a zip of its folder", "mcap": "an MCAP"}


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
            files = stack.enter_context(unpacked(path, settings))
            bag: Bag = JoinedBags([_open(each, "rosbag2", settings) for each in files])
        else:
            bag = _open(path, kind, settings)
        channel = _choose(bag.channels(), options.topic, bag)
        yield read_channel(bag, channel, options.joint_names, settings)


def _open(path: Path, kind: str, settings: Settings) -> Bag:
    with path.open("rb") as file:
        start = file.read(16)
    if start.startswith(mcap.MAGIC):
        return mcap.Mcap(path, settings)
    if start.startswith(rosbag1.MAGIC):
        return rosbag1.Rosbag1(path, settings)
    if start.startswith(sqlite.MAGIC):
        return sqlite.SqliteBag(path, settings)
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
        found = [each for each in by_name.values() if each.topic == topic]
        if not found and any(each.topic == topic for each in channels):
            other = next(each for each in channels if each.topic == topic)
            raise invalid_request("topic", f"{topic} of type {other.type} ({other.encoding})", _types())
        if not found:
            raise invalid_request("topic", topic, f"one of {_listed(known or channels)}")
    else:
        found = list(by_name.values())
        if not found:
            raise invalid_data("file", f"a bag of {_listed(channels)}", f"a topic of {_types()}")
    if len(found) > 1:
        raise _ambiguous(known)
    return found[0]


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

"""Reading a bag as a table: the topics with joint states are chosen, and several topics are merged by time."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from service.datasets.formats.bags.containers import Topic, read_messages
from service.datasets.formats.bags.decoding import ENCODINGS, make_decoder
from service.datasets.formats.bags.fields import find_fields
from service.datasets.formats.bags.source import NS, Samples, Source
from service.datasets.formats.table import Table, clean_names, first_line, stack_blocks, unreadable
from service.datasets.formats.zips import unpack_bag
from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError, ServiceError, invalid_data, invalid_request, readable
from service.foundation.settings import Settings

JOINT_STATE = "sensor_msgs/JointState"
PROBED = 20
"""Max messages of a topic from which its fields are found."""
MAX_PROBED_BYTES = 256 * 1024
"""Max size of a message with joint states. Larger ones are images and point clouds."""
MAX_GAP_STEPS = 5.0
"""Max distance of two messages between which numbers are interpolated, in median distances."""
QUANTITIES = ("q", "dq", "ddq", "tau")


@dataclass
class Bag:
    """The files of a recording, in order."""

    files: Sequence[Path]
    facts: list[str] = field(default_factory=list)

    def messages(self) -> Iterator[tuple[Topic, int, bytes]]:
        """Yield the topic, reception time in ns and data of all messages."""
        for file in self.files:
            yield from read_messages(file, self.facts)


@contextmanager
def open_bag(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open a bag, or the zip of a bag's folder, as a table with columns such as `t` and `<joint>/position`.

    Raise InvalidDataError, InvalidRequestError if the topic is wrong, or TooLargeError.
    """
    with ExitStack() as stack:
        with path.open("rb") as file:
            zipped = file.read(4) == b"PK\x03\x04"
        bag = Bag(stack.enter_context(unpack_bag(path, settings)) if zipped else [path])
        sources, chosen = _choose_sources(bag, options.topic)
        by_topic = {each.topic: each for each in sources}
        for topic, received, data in bag.messages():
            if topic in by_topic:
                by_topic[topic].collect(received, data, settings)
        samples = [sources[0].arrange(options.joint_names, settings)]
        samples += [_matching(each, sources[0], samples[0].joints, settings) for each in sources[1:]]
        yield _table(sources, samples, [*bag.facts, *chosen])


def _matching(source: Source, first: Source, joints: tuple[str, ...], settings: Settings) -> Samples:
    try:
        return source.arrange(joints, settings)
    except InvalidDataError as error:
        expected = f"those of topic {first.topic.name}, {', '.join(joints)[:200]}. Choose other topics with `topic`"
        raise source.error(f"other joints ({error.message})", expected) from None


def _table(sources: Sequence[Source], samples: Sequence[Samples], facts: list[str]) -> Table:
    joints = samples[0].joints
    of = {quantity: place for place, each in enumerate(samples) for quantity in each.values}
    if "tau" not in of:
        raise sources[0].error("no effort: it is empty in all messages", "the torque of each joint")
    if "q" not in of:
        raise sources[0].error("no positions", "the position of each joint")
    times, values = _merge(samples)
    start = int(times[0])
    facts += [fact for each in samples for fact in each.facts]
    names, columns, units = list[str](), list[Array](), {"t": "s"}
    if times.any():
        names, columns = ["t"], [(times - start) / NS]
        facts.append(f"times count from {start // NS}.{start % NS:09d} s")
    for quantity in [each for each in QUANTITIES if each in of]:
        read = sources[of[quantity]].fields
        for j, joint in enumerate(joints):
            names.append(f"{joint}/{read.quantities[quantity].column}")
            columns.append(values[quantity][:, j])
            if quantity in read.units:
                units[names[-1]] = read.units[quantity]
    return Table(clean_names(names), stack_blocks(columns), joints, units, facts)


def _merge(samples: Sequence[Samples]) -> tuple[NDArray[np.int64], dict[str, Array]]:
    """Return the times of the topic with the fewest messages, and all numbers at these times.

    Numbers of other topics are interpolated, NaN if their neighbours are far apart. The times are header stamps only if
    all topics have them.
    """
    if len(samples) == 1:
        return samples[0].times, dict(samples[0].values)
    stamped = all(each.stamped for each in samples)
    clocks = [each.times if stamped else each.received for each in samples]
    slowest = min(clocks, key=len)
    begin, end = max(each.min() for each in clocks), min(each.max() for each in clocks)
    times = np.sort(slowest[(slowest >= begin) & (slowest <= end)])
    if not len(times):
        raise invalid_data("topic", "topics that were recorded at different times", "topics of the same time")
    values = {}
    for each, clock in zip(samples, clocks, strict=True):
        order = np.argsort(clock, kind="stable")
        known = (clock[order] - times[0]).astype(float)
        at = (times - times[0]).astype(float)
        right = np.clip(np.searchsorted(known, at), 1, max(len(known) - 1, 1))
        gaps = np.diff(known, append=known[-1])
        far = (gaps[right - 1] > MAX_GAP_STEPS * np.median(gaps[:-1])) & ~np.isin(at, known)
        for quantity, numbers in each.values.items():
            columns = [np.interp(at, known, column[order]) for column in numbers.T]
            values[quantity] = np.where(far[:, None], np.nan, np.column_stack(columns))
    return times, values


def _choose_sources(bag: Bag, given: str | None) -> tuple[list[Source], list[str]]:
    """Return the topics to read, the one with positions first, and sentences about the choice."""
    counts, probed = Counter[Topic](), defaultdict[Topic, list[bytes]](list)
    for topic, _, data in bag.messages():
        counts[topic] += 1
        if len(probed[topic]) < PROBED and len(data) <= MAX_PROBED_BYTES and topic.encoding in ENCODINGS:
            probed[topic].append(bytes(data))
    if not counts:
        message = "; ".join(["The bag has no messages", *bag.facts])
        raise invalid_data("file", "a bag without messages", "joint states", message)
    sources, failed = _find_sources(probed)
    if given is not None:
        return _take([_named(name.strip(), sources, failed, counts) for name in given.split(",")]), []
    if not sources and failed:
        raise next(iter(failed.values()))
    if not sources:
        raise invalid_data("file", f"a bag of the topics {_listed(counts)}", _EXPECTED)
    return _choose(sources, counts)


def _find_sources(probed: dict[Topic, list[bytes]]) -> tuple[list[Source], dict[str, ServiceError]]:
    """Return the topics with numbers of joints, and the errors of topics that cannot be read by name."""
    sources, failed = [], {}
    for topic, messages in probed.items():
        decoded, reason = [], ""
        try:
            decode = make_decoder(topic)
        except ServiceError as error:
            failed[topic.name] = error
            continue
        for data in messages:
            try:
                decoded.append(decode(data))
            except Exception as error:  # of the decoders, for damaged messages
                reason = reason or first_line(error)
        fields = find_fields(topic, decoded) if decoded else None
        if fields is not None:
            read = tuple(each for each in QUANTITIES if each in fields.quantities)
            sources.append(Source(topic, decode, fields, read))
        elif reason:
            failed[topic.name] = unreadable(f"topic {topic.name}", reason, f"messages of type {topic.type}")
    return sources, failed


def _named(name: str, sources: list[Source], failed: dict[str, ServiceError], counts: Counter[Topic]) -> Source:
    for source in sources:
        if source.topic.name == name:
            return source
    if name in failed:
        raise failed[name]
    for topic in counts:
        if topic.name == name:
            raise invalid_request("topic", f"{name} of type {topic.type} ({topic.encoding})", _EXPECTED)
    known = Counter({each.topic: counts[each.topic] for each in sources}) or counts
    raise invalid_request("topic", name, f"one of {_listed(known)}")


def _choose(sources: list[Source], counts: Counter[Topic]) -> tuple[list[Source], list[str]]:
    """Choose the topics, measured before commanded; raise InvalidDataError if several fit."""
    measured = [each for each in sources if not each.fields.commanded] or sources
    positions, torques = ([each for each in measured if quantity in each.quantities] for quantity in ("q", "tau"))
    both = [each for each in positions if each in torques]
    states = [each for each in both if each.topic.type == JOINT_STATE]
    if len(states) == 1 or len(both) == 1:
        chosen = states if len(states) == 1 else both
    elif not both and len(positions) <= 1 and len(torques) <= 1 and positions + torques:
        package = (positions + torques)[0].topic.type.partition("/")[0]
        speeds = [
            each for each in measured if each not in [*positions, *torques] and each.topic.type.startswith(package)
        ]
        chosen = _take([*positions, *torques, *(speeds if len(speeds) == 1 else [])])
    elif not positions and not torques:
        raise invalid_data("file", f"a bag of the topics {_listed(counts)}", _EXPECTED)
    else:
        several = both or [*positions, *torques]
        listed = _listed(Counter({each.topic: counts[each.topic] for each in several}))
        example = (
            several[0].topic.name if both else ",".join(each[0].topic.name for each in (positions, torques) if each)
        )
        remedy = f"Set `topic`, because the bag has several: {listed}. For example topic={example}"
        raise invalid_data("topic", "missing", f"one of {listed}", remedy)
    facts = ["the topics are merged by time"] if len(chosen) > 1 else []
    if left := [readable(each.topic.name[:100]) for each in sources if each not in chosen]:
        facts.append(f"topics not read: {', '.join(left[:20])}")
    return chosen, facts


def _take(sources: list[Source]) -> list[Source]:
    """Return the sources with each quantity read from the first topic that has it, the one with positions first."""
    sources = sorted(sources, key=lambda each: "q" not in each.quantities)
    taken: set[str] = set()
    for each in sources:
        each.quantities = tuple(quantity for quantity in each.quantities if quantity not in taken)
        taken |= set(each.quantities)
    return [each for each in sources if each.quantities]


_EXPECTED = "a topic with a position and a torque of each joint, such as one of type sensor_msgs/JointState"


def _listed(counts: Counter[Topic]) -> str:
    totals = Counter[tuple[str, str]]()
    for each, count in counts.items():
        totals[each.name, each.type] += count
    listed = [
        f"{readable(name[:100])} ({readable(kind[:100])}, {count} messages)"
        for (name, kind), count in list(totals.items())[:20]
    ]
    return ", ".join(listed) + (f" and {len(totals) - 20} more" if len(totals) > 20 else "")

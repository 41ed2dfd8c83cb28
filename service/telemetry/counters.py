"""Counters of one process, and their sums over all processes of a service, in memory that they share.

Each process has a part of the memory that only it writes. So there are no locks, and a process that is killed loses
nothing: the one that is started in its place continues its part.
"""

from __future__ import annotations

import logging
import mmap
import os
from collections import defaultdict
from collections.abc import Mapping, MutableSequence, Sequence
from struct import Struct
from threading import Lock
from typing import TypeAlias

logger = logging.getLogger(__name__)
COUNTS, REALS, NAME_BYTES = 24, 8, 256
"""Numbers of a tally of each type, and max size of its name: those of 19 buckets fit."""
_NUMBER = 8
RECORD_BYTES = NAME_BYTES + _NUMBER * (COUNTS + REALS)
MAX_TALLIES = 32_000
"""Tallies of one process. Further ones are of this process alone, and are lost when it ends."""
HEADER_BYTES = 512
"""Of a part: the number of its tallies, its process, then its gauges."""
PART_BYTES = HEADER_BYTES + MAX_TALLIES * RECORD_BYTES
_LENGTH = Struct("<H")
_SEPARATOR = "\x1f"

Name = tuple[str, ...]
Counts: TypeAlias = "MutableSequence[int] | memoryview[int]"
Reals: TypeAlias = "MutableSequence[float] | memoryview[float]"


class Tally:
    """Numbers that belong together: counts, and real numbers such as sums of durations."""

    __slots__ = ("counts", "reals")

    def __init__(self, counts: Counts, reals: Reals) -> None:
        self.counts, self.reals = counts, reals


def new_tally() -> Tally:
    """Return a tally of this process alone."""
    return Tally([0] * COUNTS, [0.0] * REALS)


class Gauge:
    """A number of things that are open now."""

    __slots__ = ("_others", "_own")

    def __init__(self, own: Counts, others: Sequence[Counts] = ()) -> None:
        self._own, self._others = own, others

    def add(self, number: int) -> None:
        """Add a number, which may be negative."""
        self._own[0] += number

    @property
    def total(self) -> int:
        """The number in all processes."""
        total = self._own[0]
        for other in self._others:
            total += other[0]
        return total


def new_gauge() -> Gauge:
    """Return a gauge of this process alone."""
    return Gauge([0])


class CounterMemory:
    """Memory for the counters of a number of processes; create it before they are forked."""

    def __init__(self, parts: int) -> None:
        self._memory = memoryview(mmap.mmap(-1, parts * PART_BYTES))  # pages that nobody writes take no memory
        self.parts = [self._memory[at : at + PART_BYTES] for at in range(0, parts * PART_BYTES, PART_BYTES)]


class Counters:
    """The counters of one process. It reads those of the others, too.

    memory: shared with the others, None for a process alone; part: the part that this process writes.
    """

    GAUGES = ("requests", "streams", "admitted requests", "admitted streams")
    """Names of the gauges."""

    def __init__(self, memory: CounterMemory | None = None, part: int = 0) -> None:
        self._parts = [] if memory is None else [_Part(each) for each in memory.parts]
        self._own = self._parts[part] if self._parts else None
        self._tallies: dict[Name, Tally] = {}
        self._alone: dict[str, dict[Name, Tally]] = defaultdict(dict)  # by kind; those beyond the memory
        self._lock = Lock()
        self._gauges = {name: self._gauge(place) for place, name in enumerate(self.GAUGES)}
        if self._own is not None:
            self._own.enter()
            self.clear_gauges(part)  # of a process that was killed

    def tally(self, *name: str) -> Tally:
        """Return this process's tally of a name, whose first part is its kind."""
        found = self._tallies.get(name)
        if found is not None:
            return found
        with self._lock:
            kind, *rest = name
            found = self._tallies.get(name) or (None if self._own is None else self._own.tally(kind, tuple(rest)))
            if found is None:
                found = self._alone[kind][tuple(rest)] = new_tally()
            self._tallies[name] = found
        return found

    def tallies(self, kind: str) -> Mapping[Name, Sequence[Tally]]:
        """Return the tallies of a kind of all processes, by the rest of their names."""
        found: dict[Name, list[Tally]] = defaultdict(list)
        for tallies in (*(part.tallies(kind) for part in self._parts), self._alone.get(kind, {}).copy()):
            for name, tally in tallies.items():
                found[name].append(tally)
        return found

    def gauge(self, name: str) -> Gauge:
        """Return the gauge of a name of `GAUGES`."""
        return self._gauges[name]

    def clear_gauges(self, part: int) -> None:
        """Set the gauges of a part to zero, whose process has ended."""
        self._parts[part].clear_gauges(len(self.GAUGES))

    def others(self) -> list[int]:
        """Return the ids of the other processes; some of them may have ended."""
        return [part.pid for part in self._parts if part is not self._own and part.pid]

    def _gauge(self, place: int) -> Gauge:
        if self._own is None:
            return new_gauge()
        return Gauge(self._own.gauge(place), [part.gauge(place) for part in self._parts if part is not self._own])


class _Part:
    """A part of the memory: a header and records, each with a name and numbers."""

    def __init__(self, memory: memoryview) -> None:
        self._memory = memory
        self._header = memory[:HEADER_BYTES].cast("q")
        self._tallies: dict[str, dict[Name, Tally]] = defaultdict(dict)  # by kind: those read so far
        self._read, self._lock = 0, Lock()

    @property
    def pid(self) -> int:
        """The process that writes the part, or has written it last; 0 if there was none."""
        return self._header[1]

    def enter(self) -> None:
        """Note that this process writes the part."""
        self._header[1] = os.getpid()

    def gauge(self, place: int) -> memoryview:
        """Return the number of a gauge."""
        return self._header[2 + place : 3 + place]

    def clear_gauges(self, number: int) -> None:
        """Set all gauges to zero."""
        for place in range(number):
            self._header[2 + place] = 0

    def tallies(self, kind: str) -> dict[Name, Tally]:
        """Return the tallies of a kind."""
        with self._lock:
            self._read_new()
            return self._tallies[kind].copy()

    def tally(self, kind: str, name: Name) -> Tally | None:
        """Return a tally, which is added if it is new; return None if there is no room for it.

        Only the process that writes the part calls this.
        """
        with self._lock:
            self._read_new()
            if (found := self._tallies[kind].get(name)) is None and self._add(_SEPARATOR.join((kind, *name)).encode()):
                self._read_new()
                found = self._tallies[kind][name]
            return found

    def _add(self, name: bytes) -> bool:
        place = self._header[0]
        if place == MAX_TALLIES or len(name) > NAME_BYTES - _LENGTH.size:
            logger.warning("no room for the counter %r: it is lost at a restart", name)
            return False
        record = self._record(place)
        _LENGTH.pack_into(record, 0, len(name))
        record[_LENGTH.size : _LENGTH.size + len(name)] = name
        self._header[0] = place + 1  # only now do others read it
        return True

    def _read_new(self) -> None:
        while self._read < self._header[0]:
            record = self._record(self._read)
            end = _LENGTH.size + _LENGTH.unpack_from(record)[0]
            kind, *name = bytes(record[_LENGTH.size : end]).decode().split(_SEPARATOR)
            middle = NAME_BYTES + _NUMBER * COUNTS
            self._tallies[kind][tuple(name)] = Tally(record[NAME_BYTES:middle].cast("q"), record[middle:].cast("d"))
            self._read += 1

    def _record(self, place: int) -> memoryview:
        begin = HEADER_BYTES + place * RECORD_BYTES
        return self._memory[begin : begin + RECORD_BYTES]

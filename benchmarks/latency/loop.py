"""A control loop that sends one query at every tick of a clock, and counts late answers."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from benchmarks.timing import Ask, Nanoseconds

RATE = 1000.0
"""Queries a second."""
DEADLINE_MS = 1.0
"""Max time from a tick to its answer; a later answer is a miss."""
_SPIN_NS = 400_000
"""Time before a tick from which the loop spins, as a sleep may end that late.

Spinning all the time makes more answers late: the scheduler then interrupts the loop at any moment.
"""
_LEAD_NS = 5_000_000


@dataclass(frozen=True)
class Loop:
    """Figures of a loop. Delays in ms, from tick to answer; clusters: sequences of successive misses."""

    ticks: int
    misses: int
    clusters: int
    longest_cluster: int
    p50: float
    p99: float
    p999: float
    largest: tuple[float, ...]

    @property
    def share(self) -> float:
        """Share of ticks that were missed."""
        return self.misses / self.ticks


def run_slice(ask: Ask, ticks: int, rate: float = RATE, start: int = 0) -> Nanoseconds:
    """Send a query at every tick of an absolute schedule; return the delays from tick to answer, ns.

    A late answer delays the next query, not its tick, so that all answers delayed by one stall count.
    """
    period, clock = round(1e9 / rate), time.perf_counter_ns
    delays = np.empty(ticks, dtype=np.int64)
    first = clock() + _LEAD_NS
    for index in range(ticks):
        tick = first + index * period
        if (left := tick - clock()) > _SPIN_NS:
            time.sleep((left - _SPIN_NS) / 1e9)
        while clock() < tick:
            pass
        ask(start + index)
        delays[index] = clock() - tick
    return delays


def summarise(slices: Sequence[Nanoseconds], shown: int = 3) -> Loop:
    """Summarise all slices; clusters end with their slice."""
    lengths = [length for part in slices for length in _clusters(part)]
    delays = np.concatenate(slices) / 1e6
    p50, p99, p999 = (float(value) for value in np.percentile(delays, (50, 99, 99.9)))
    return Loop(
        ticks=len(delays),
        misses=sum(lengths),
        clusters=len(lengths),
        longest_cluster=max(lengths, default=0),
        p50=p50,
        p99=p99,
        p999=p999,
        largest=tuple(float(value) for value in np.sort(delays)[::-1][:shown]),
    )


def excess(asked: Loop, floor: Loop) -> float:
    """Return the share of missed ticks minus that of the floor."""
    return asked.share - floor.share


def _clusters(delays: Nanoseconds) -> list[int]:
    late = np.concatenate([[False], delays > DEADLINE_MS * 1e6, [False]])
    edges = np.flatnonzero(late[1:] != late[:-1])
    return [int(stop - start) for start, stop in list(pairwise(edges.tolist()))[::2]]

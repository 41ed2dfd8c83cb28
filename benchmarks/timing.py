"""Timing of repeated calls: percentiles and throughput."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Nanoseconds = NDArray[np.int64]
Ask = Callable[[int], object]
"""A function that sends query number k and waits for the answer."""

PERCENTILES = (50.0, 90.0, 99.0, 99.9)
WARM_UP = 5
"""Calls before every measured stretch: caches still hold data of the previous subject."""


@dataclass(frozen=True)
class Timing:
    """Percentiles of one run of one subject, µs a query, queries per second, and the number of measured calls."""

    count: int
    p50: float
    p90: float
    p99: float
    p999: float
    largest: float
    per_second: float

    @classmethod
    def of(cls, times: Nanoseconds, queries: int = 1) -> Timing:
        """Summarise calls that took `times` ns, each answering `queries` queries; raise ValueError without calls."""
        if len(times) == 0:
            raise ValueError("Percentiles need at least one time.")
        each = times / (1e3 * queries)
        p50, p90, p99, p999 = (float(value) for value in np.percentile(each, PERCENTILES))
        return cls(
            len(times), p50, p90, p99, p999, float(each.max()), queries * len(times) / (float(times.sum()) / 1e9)
        )


def median(runs: Sequence[Timing]) -> Timing:
    """Return the median of every figure over runs; `largest` is the maximum."""
    return Timing(
        count=sum(run.count for run in runs),
        **{name: float(np.median([getattr(run, name) for run in runs])) for name in ("p50", "p90", "p99", "p999")},
        largest=max(run.largest for run in runs),
        per_second=float(np.median([run.per_second for run in runs])),
    )


def measure(ask: Ask, count: int, start: int = 0) -> Nanoseconds:
    """Time `count` calls one after another, with queries numbered from `start`; return ns each."""
    times, clock = np.empty(count, dtype=np.int64), time.perf_counter_ns
    for number in range(start, start + WARM_UP):
        ask(number)
    for index in range(count):
        number = start + index
        began = clock()
        ask(number)
        times[index] = clock() - began
    return times


@contextmanager
def no_collection() -> Iterator[None]:
    """Disable the garbage collector of this process during a measurement."""
    enabled = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
        gc.unfreeze()

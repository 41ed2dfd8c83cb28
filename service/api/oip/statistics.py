"""Statistics of inference requests by version, as Triton's statistics extension defines them."""

from __future__ import annotations

import time
from time import perf_counter_ns
from typing import Any

from service.telemetry.counters import Counters, Counts

STAGES = ("success", "fail", "queue", "compute_input", "compute_infer", "compute_output", "cache_hit", "cache_miss")


class Timing:
    """The times of one request, ns. rows: number of its queries."""

    __slots__ = ("began", "queue", "read", "rows", "started")

    def __init__(self) -> None:
        self.began = self.read = self.started = perf_counter_ns()
        self.queue = self.rows = 0

    def start(self) -> None:
        """Note that a thread is free, or that none is needed."""
        now = perf_counter_ns()
        self.queue += now - self.started
        self.started = now

    def note_read(self, rows: int) -> None:
        """Note that the request is decoded and checked."""
        self.read, self.started, self.rows = perf_counter_ns() - self.started, perf_counter_ns(), rows


_STATISTICS = "inference"
"""Kind of the counters: number and time of each stage in ns, number of queries, and time of the last one in ms."""
_PLACES = {stage: 2 * place for place, stage in enumerate(STAGES)}
_ROWS, _LAST = 2 * len(STAGES), 2 * len(STAGES) + 1


class Statistics:
    """Counters of all versions since the start of the service. They are changed only by the event loop."""

    def __init__(self, counters: Counters | None = None) -> None:
        self._counters = Counters() if counters is None else counters

    def succeed(self, model: str, version: int, timing: Timing) -> None:
        """Count an answered request."""
        counts, total = self._counts(model, version), perf_counter_ns() - timing.began
        infer = total - timing.queue - timing.read
        parts = (("success", total), ("queue", timing.queue), ("compute_input", timing.read), ("compute_infer", infer))
        for name, ns in (*parts, ("compute_output", 0)):  # the answer is encoded while it is computed
            _add(counts, name, ns)
        counts[_ROWS] += timing.rows
        counts[_LAST] = time.time_ns() // 1_000_000

    def fail(self, model: str, version: int, timing: Timing) -> None:
        """Count a rejected request."""
        _add(self._counts(model, version), "fail", perf_counter_ns() - timing.began)

    def show(self, model: str, version: int) -> dict[str, Any]:
        """Return the statistics of a version. Durations are sums, ns; `last_inference` is Unix time, ms."""
        tallies = self._counters.tallies(_STATISTICS).get((model, str(version)), ())
        totals = [sum(each.counts[place] for each in tallies) for place in range(_LAST)]
        return {
            "name": model,
            "version": str(version),
            "last_inference": max((each.counts[_LAST] for each in tallies), default=0),
            "inference_count": totals[_ROWS],
            "execution_count": totals[_PLACES["success"]],
            "inference_stats": {
                name: {"count": totals[place], "ns": totals[place + 1]} for name, place in _PLACES.items()
            },
            "batch_stats": [],
        }

    def _counts(self, model: str, version: int) -> Counts:
        return self._counters.tally(_STATISTICS, model, str(version)).counts


def _add(counts: Counts, stage: str, ns: int) -> None:
    place = _PLACES[stage]
    counts[place] += 1
    counts[place + 1] += ns

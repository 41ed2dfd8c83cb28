"""Statistics of inference requests by version, as Triton's statistics extension defines them."""

from __future__ import annotations

import time
from time import perf_counter_ns
from typing import Any

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


class Statistics:
    """Counters of all versions since the start of the service. They are changed only by the event loop."""

    def __init__(self) -> None:
        self._last: dict[tuple[str, int], int] = {}
        self._rows: dict[tuple[str, int], int] = {}
        self._stages: dict[tuple[str, int], dict[str, list[int]]] = {}

    def succeed(self, model: str, version: int, timing: Timing) -> None:
        """Count an answered request."""
        key, total = (model, version), perf_counter_ns() - timing.began
        stages = self._of(key)
        infer = total - timing.queue - timing.read
        parts = (("success", total), ("queue", timing.queue), ("compute_input", timing.read), ("compute_infer", infer))
        for name, ns in (*parts, ("compute_output", 0)):  # the answer is encoded while it is computed
            stages[name][0] += 1
            stages[name][1] += ns
        self._rows[key] += timing.rows
        self._last[key] = time.time_ns() // 1_000_000

    def fail(self, model: str, version: int, timing: Timing) -> None:
        """Count a rejected request."""
        stage = self._of((model, version))["fail"]
        stage[0] += 1
        stage[1] += perf_counter_ns() - timing.began

    def show(self, model: str, version: int) -> dict[str, Any]:
        """Return the statistics of a version. Durations are sums, ns; `last_inference` is Unix time, ms."""
        key = model, version
        stages = self._stages.get(key, {})
        counts = {name: stages.get(name, (0, 0)) for name in STAGES}
        return {
            "name": model,
            "version": str(version),
            "last_inference": self._last.get(key, 0),
            "inference_count": self._rows.get(key, 0),
            "execution_count": counts["success"][0],
            "inference_stats": {name: {"count": count, "ns": ns} for name, (count, ns) in counts.items()},
            "batch_stats": [],
        }

    def _of(self, key: tuple[str, int]) -> dict[str, list[int]]:
        found = self._stages.get(key)
        if found is None:
            found = self._stages[key] = {name: [0, 0] for name in STAGES}
            self._rows[key] = 0
        return found

"""Targets of latency, and whether a run met them; every value is a median over runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from benchmarks.latency.loop import excess
from benchmarks.latency.results import Results, State
from benchmarks.timing import Timing

Sense = Literal["≤", "<", "≥"]
Figure = Callable[[Timing], float]

ANSWERS = {"std": "in process, with std", "ws": "WebSocket", "http": "HTTP JSON"}
"""Subjects with targets for tails and for latency while training."""


@dataclass(frozen=True)
class Target:
    """A measured value and its limit; value None: not measured, limit None: reported without a target."""

    name: str
    value: float | None
    unit: str
    sense: Sense = "≤"
    limit: float | None = None

    @property
    def met(self) -> bool | None:
        """Whether the value is within the limit; None without value or limit."""
        if self.value is None or self.limit is None:
            return None
        return {"≤": self.value <= self.limit, "<": self.value < self.limit, "≥": self.value >= self.limit}[self.sense]


def targets(results: Results) -> list[Target]:
    """Return all targets of latency."""
    found = [
        Target("largest deviation from the exact posterior", 100 * results.deviation, "% of std", "≤", 2),
        Target(
            "the same at the queries of another trajectory",
            None if results.unseen is None else 100 * results.unseen,
            "% of std",
            "≤",
            2,
        ),
        Target("in process, with std: p50", single(results.of("std"), p50), "µs", "≤", 200),
        Target("in process, mean only: p50", single(results.of("mean"), p50), "µs", "≤", 40),
        Target("in process, batch of 1000, with std: p50 a query", single(results.of("batch"), p50), "µs", "≤", 60),
        Target("WebSocket: p50 above the floor", above_floor(results, "ws"), "µs", "≤", 250),
        Target("HTTP JSON: p50 above the floor", above_floor(results, "http"), "µs", "≤", 350),
    ]
    for key, name in ANSWERS.items():
        tail = paired(results.of(key), results.of(key), lambda run: run.p99, p50)
        found.append(Target(f"{name}: p99 / p50, idle", tail, "×", "≤", 4))
    for key, name in ANSWERS.items():
        for label, figure, limit in (("p50", p50, 1.5), ("p99", p99, 3.0)):
            ratio = paired(results.of(key, "training"), results.of(key), figure, figure)
            found.append(Target(f"{name}: {label} while training / idle", ratio, "×", "≤", limit))
    found.append(Target("1 kHz WebSocket loop: late answers minus the floor's", late(results, "idle"), "%", "<", 0.1))
    found += [
        Target("the same while training (no target)", late(results, "training"), "%", "<"),
        Target("speed-up over the exact GP, with std", speed_up(results, "exact"), "×", "≥", 100),
        Target("speed-up over GPyTorch (no target)", speed_up(results, "gpytorch"), "×", "≥"),
        Target("speed-up over GPyTorch, fast_pred_var (no target)", speed_up(results, "gpytorch-fast"), "×", "≥"),
    ]
    return found


def p50(run: Timing) -> float:
    """Return the median of a run."""
    return run.p50


def p99(run: Timing) -> float:
    """Return the 99th percentile of a run."""
    return run.p99


def single(runs: Sequence[Timing] | None, figure: Figure) -> float | None:
    """Return the median of a figure over runs."""
    return None if not runs else float(np.median([figure(run) for run in runs]))


def paired(
    above: Sequence[Timing] | None, below: Sequence[Timing] | None, numerator: Figure, denominator: Figure
) -> float | None:
    """Return the median over runs of the ratio of two figures of the same run."""
    if not above or not below:
        return None
    return float(np.median([numerator(a) / denominator(b) for a, b in zip(above, below, strict=True)]))


def above_floor(results: Results, key: str, state: State = "idle") -> float | None:
    """Return the median over runs of p50 minus the p50 of an echo with bodies of the same size, µs."""
    row = results.rows.get(key)
    runs, floor = results.of(key, state), None if row is None or row.floor is None else results.of(row.floor, state)
    if not runs or not floor:
        return None
    return float(np.median([run.p50 - below.p50 for run, below in zip(runs, floor, strict=True)]))


def speed_up(results: Results, key: str) -> float | None:
    """Return the time of a baseline over that of one query with standard deviation, in process and idle."""
    return paired(results.of(key), results.of("std"), p50, p50)


def late(results: Results, state: State) -> float | None:
    """Return late answers of the control loop minus the echo's, % of the ticks; at least 0."""
    pair = results.loops.get(state)
    return None if pair is None else 100 * max(0.0, excess(pair.asked, pair.floor))

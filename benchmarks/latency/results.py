"""Results of the latency benchmark: plain data, written as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from benchmarks.latency.loop import Loop
from benchmarks.timing import Timing

State = Literal["idle", "training"]
STATES: tuple[State, ...] = ("idle", "training")


@dataclass
class Row:
    """One subject and its runs; floor: key of the echo of its transport."""

    key: str
    label: str
    floor: str | None = None
    runs: dict[State, list[Timing]] = field(default_factory=dict)


@dataclass(frozen=True)
class LoopPair:
    """The control loop on the model and on the echo, in alternating slices.

    Attributes:
        server_late: late answers by the service's own count, from arrival of a query to departure of its answer. The
            other late answers were delayed by network, scheduler or client.
    """

    asked: Loop
    floor: Loop
    server_late: int


@dataclass(frozen=True)
class MotionRow:
    """Size of the model of one kind of training motion, and its latencies in process (p50, µs a query)."""

    motion: str
    samples: int
    compact: Mapping[str, float]
    mean: float
    std: float
    batch: float


@dataclass
class Results:
    """All figures of a benchmark.

    Attributes:
        facts: machine and packages.
        model: the measured model.
        deviation: largest deviation from the exact posterior as fitted, in standard deviations.
        notes: remarks on single rows.
        unseen: largest deviation at the queries, if the exact posterior was computed.
    """

    facts: dict[str, str]
    model: dict[str, str]
    deviation: float
    runs: int
    queries: int
    rows: dict[str, Row] = field(default_factory=dict)
    loops: dict[State, LoopPair] = field(default_factory=dict)
    motions: list[MotionRow] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    unseen: float | None = None

    def of(self, key: str, state: State = "idle") -> list[Timing] | None:
        """Return the runs of a subject in a state; None if it was not measured."""
        row = self.rows.get(key)
        return None if row is None else row.runs.get(state)

    def as_dict(self) -> dict[str, Any]:
        """Return the results as JSON values."""
        return asdict(self)

    def write(self, path: Path, targets: list[dict[str, Any]]) -> None:
        """Write the results and the targets as JSON."""
        path.write_text(json.dumps({**self.as_dict(), "targets": targets}, indent=2) + "\n")

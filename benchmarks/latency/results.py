"""What a benchmark found: plain data, written as JSON."""

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
    """One subject and its runs; floor: key of the echo that its transport is compared with."""

    key: str
    label: str
    floor: str | None = None
    runs: dict[State, list[Timing]] = field(default_factory=dict)


@dataclass(frozen=True)
class LoopPair:
    """The control loop on the model and on the echo, in alternating slices.

    server_late: answers that the service itself counted as late, from the arrival of a query to the departure of its
    answer; the rest of the late ones waited in the network, for the processor, or in the client.
    """

    asked: Loop
    floor: Loop
    server_late: int


@dataclass(frozen=True)
class MotionRow:
    """How large a model one kind of training motion makes, and how fast it answers in process, p50 in µs a query."""

    motion: str
    samples: int
    compact: Mapping[str, float]
    mean: float
    std: float
    batch: float


@dataclass
class Results:
    """Everything that is printed.

    facts: machine and packages; model: what was measured; deviation: the largest from the exact posterior, in standard
    deviations, as fitted; unseen: the same at the queries, where it was compared; notes: what a reader has to
    know about single rows.
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
        """Runs of a subject in a state, None where it was not measured."""
        row = self.rows.get(key)
        return None if row is None else row.runs.get(state)

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return asdict(self)

    def write(self, path: Path, targets: list[dict[str, Any]]) -> None:
        """Write everything, with the targets, as JSON."""
        path.write_text(json.dumps({**self.as_dict(), "targets": targets}, indent=2) + "\n")

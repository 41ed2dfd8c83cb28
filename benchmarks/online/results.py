"""Results of the benchmark of learning: plain data, written as JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.online.asking import LoopFigures
from benchmarks.online.cost import Cost
from benchmarks.online.flow import Flow
from benchmarks.online.quality import Method


@dataclass
class Results:
    """All figures; None or empty if not measured.

    Attributes:
        facts: machine and packages.
        model: the learning model.
        idle: loop without learning.
        learning: loop during the stream in real time.
        pushed: loop during the stream sent as fast as possible.
        live: stream in real time.
        burst: stream sent as fast as possible.
        costs: cost of an update.
        joints: names of the joints.
        moments: names of the moments, in order.
        methods: quality of each method.
        robots: number of robots with merged statistics.
        merged: relative difference of merged statistics from training on all samples at once.
        notes: remarks.
    """

    facts: dict[str, str]
    model: dict[str, str]
    idle: LoopFigures | None = None
    learning: LoopFigures | None = None
    pushed: LoopFigures | None = None
    live: Flow | None = None
    burst: Flow | None = None
    costs: list[Cost] = field(default_factory=list)
    joints: tuple[str, ...] = ()
    moments: list[str] = field(default_factory=list)
    methods: dict[str, Method] = field(default_factory=dict)
    robots: int = 0
    merged: float | None = None
    notes: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """Return the results as JSON values."""
        return asdict(self)

    def write(self, path: Path, targets: list[dict[str, Any]]) -> None:
        """Write the results and the targets as JSON."""
        path.write_text(json.dumps({**self.as_dict(), "targets": targets}, indent=2) + "\n")

"""What the benchmark of learning found: plain data, written as JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.online.asking import Asked
from benchmarks.online.cost import Cost
from benchmarks.online.flow import Flow
from benchmarks.online.quality import Method


@dataclass
class Results:
    """Everything that is printed; None or empty is what was not measured.

    facts: machine and packages; model: what was taught; live: the stream in real time, burst: the one that came as fast
    as it was acknowledged; learning, pushed: who asked during each; moments: names in order; robots, merged: how many
    robots' statistics were put together, and how far the outcome lies from training on all of their samples at once,
    relative.
    """

    facts: dict[str, str]
    model: dict[str, str]
    idle: Asked | None = None
    learning: Asked | None = None
    pushed: Asked | None = None
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
        """Return it as JSON values."""
        return asdict(self)

    def write(self, path: Path, targets: list[dict[str, Any]]) -> None:
        """Write everything, with the targets, as JSON."""
        path.write_text(json.dumps({**self.as_dict(), "targets": targets}, indent=2) + "\n")

"""Results of a part of the benchmark: figures, tables and targets."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.latency.table import Grid, targets_grid
from benchmarks.latency.targets import Target


@dataclass(frozen=True)
class Part:
    """Results of one part; figures: numbers and texts for JSON."""

    name: str
    figures: dict[str, Any]
    grids: list[Grid]
    targets: list[Target] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass
class Results:
    """Results of all parts, in order."""

    machine: dict[str, str]
    parts: list[Part] = field(default_factory=list)

    def targets(self) -> list[Target]:
        """Return the targets of all parts."""
        return [each for part in self.parts for each in part.targets]

    def notes(self) -> list[str]:
        """Return the remarks of all parts."""
        return [each for part in self.parts for each in part.notes]

    def grids(self) -> Iterator[Grid]:
        """Yield all tables."""
        yield Grid("machine", ("", ""), list(self.machine.items()), texts=True)
        for part in self.parts:
            yield from part.grids
        yield targets_grid(self.targets(), "")

    def write(self, path: Path, targets: list[dict[str, Any]]) -> None:
        """Write the results and the targets as JSON."""
        parts = {part.name: part.figures for part in self.parts}
        path.write_text(json.dumps({"machine": self.machine, **parts, "targets": targets}, indent=2) + "\n")

"""What every part of the benchmark gives: figures, tables of them, and what was promised."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.latency.table import Grid, promises
from benchmarks.latency.targets import Target


@dataclass(frozen=True)
class Part:
    """One part that was measured. figures: plain numbers and texts, for JSON."""

    name: str
    figures: dict[str, Any]
    grids: list[Grid]
    targets: list[Target] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass
class Results:
    """All parts, in the order in which they were measured."""

    machine: dict[str, str]
    parts: list[Part] = field(default_factory=list)

    def targets(self) -> list[Target]:
        """What was promised, of all parts."""
        return [each for part in self.parts for each in part.targets]

    def notes(self) -> list[str]:
        """What a reader has to know."""
        return [each for part in self.parts for each in part.notes]

    def grids(self) -> Iterator[Grid]:
        """All tables."""
        yield Grid("machine", ("", ""), list(self.machine.items()), texts=True)
        for part in self.parts:
            yield from part.grids
        judged = promises(self.targets())
        yield Grid(judged.title, ("", *judged.columns[1:]), judged.rows)

    def write(self, path: Path) -> None:
        """Write everything as JSON."""
        judged = [{**asdict(each), "met": each.met} for each in self.targets()]
        parts = {part.name: part.figures for part in self.parts}
        path.write_text(json.dumps({"machine": self.machine, **parts, "targets": judged}, indent=2) + "\n")

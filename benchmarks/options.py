"""Options and output that all commands share."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Protocol

import typer
from rich.console import Console

from benchmarks.latency import table
from benchmarks.latency.targets import Target
from lipcore.robots.library import ROBOTS

Seed = Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")]
Robot = Annotated[str, typer.Option(help=f"Robot: {', '.join(ROBOTS)}.")]
JsonFile = Annotated[Path | None, typer.Option("--json", dir_okay=False, help="Also write all figures to this file.")]
Markdown = Annotated[Path | None, typer.Option(dir_okay=False, help="Also write the tables to this file.")]
Strict = Annotated[bool, typer.Option("--strict", help="Exit with 1 if a target is missed.")]

QUICK_FIT = {"hyperparameter_samples": 80, "max_iterations": 50, "starts": 1}
"""Fit options of `--quick`; the posterior still uses all samples."""


def begin() -> Console:
    """Return the console; let SIGTERM also stop the measured services."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    return Console(width=None if sys.stdout.isatty() else table.WIDTH)


def split_names(text: str) -> tuple[str, ...]:
    """Return names that commas separate."""
    return tuple(name.strip() for name in text.split(","))


class Figures(Protocol):
    """Results of a benchmark."""

    def write(self, path: Path, targets: list[dict[str, Any]]) -> None:
        """Write all figures and the targets as JSON."""


def targets_json(found: Sequence[Target]) -> list[dict[str, Any]]:
    """Return the targets as JSON values."""
    return [{**asdict(each), "met": each.met} for each in found]


def report(
    grids: Sequence[table.Grid],
    notes: Sequence[str],
    found: Sequence[Target],
    console: Console,
    markdown: Path | None,
    strict: bool,
    json_file: Path | None = None,
    results: Figures | None = None,
) -> None:
    """Print the tables and the number of missed targets; with `strict`, exit with 1 if a target is missed.

    markdown: file that the tables are written to, too. json_file: the same for all figures of the results.
    """
    if json_file is not None and results is not None:
        results.write(json_file, targets_json(found))
    table.show_grids(grids, notes, console)
    if markdown is not None:
        markdown.write_text(table.grids_markdown(grids, notes))
    missed = [each for each in found if each.met is False]
    summary = f"{len(missed)} of {sum(each.met is not None for each in found)} targets missed."
    console.print(summary if missed else "All measured targets met.", highlight=False)
    if strict and missed:
        raise typer.Exit(1)

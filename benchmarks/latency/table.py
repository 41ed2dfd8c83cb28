"""Tables of results for a terminal, a pipe and Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from benchmarks.latency.loop import DEADLINE_MS, Loop, excess
from benchmarks.latency.results import Results, State
from benchmarks.latency.targets import Target, above_floor, p50, p99, paired, targets
from benchmarks.timing import median

WIDTH = 120
NOTHING = "–"
WHEN: dict[State, str] = {"idle": "idle", "training": "while a training job runs"}


@dataclass(frozen=True)
class Grid:
    """A table of texts; with `texts`, all columns are aligned to the left, else the first only."""

    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    texts: bool = False

    def rich(self) -> Table:
        """Return the table for a terminal."""
        table = Table(
            title=self.title, title_justify="left", box=SIMPLE_HEAD, show_header=any(self.columns), padding=(0, 1, 0, 0)
        )
        for index, column in enumerate(self.columns):
            side: Literal["left", "right"] = "left" if index == 0 or self.texts else "right"
            table.add_column(column, justify=side, overflow="fold", no_wrap=index == 0)
        for row in self.rows:
            table.add_row(*map(Text, row))
        return table

    def markdown(self) -> str:
        """Return title and table as Markdown."""
        rule = ["---"] + ["---" if self.texts else "---:"] * (len(self.columns) - 1)
        lines = [_cells(self.columns), _cells(rule), *map(_cells, self.rows)]
        return f"**{self.title}**\n\n" + "\n".join(lines)


def grids(results: Results) -> list[Grid]:
    """Return all tables with rows, in order."""
    states: list[State] = [state for state in WHEN if any(row.runs.get(state) for row in results.rows.values())]
    found = [
        Grid("machine", ("", ""), list(results.facts.items()), texts=True),
        Grid("model", ("", ""), list(results.model.items()), texts=True),
        *(latencies(results, state) for state in states),
        loops(results),
        motions(results),
        targets_grid(targets(results)),
    ]
    return [grid for grid in found if grid.rows]


def latencies(results: Results, state: State) -> Grid:
    """Return percentiles and throughput of every subject in one state."""
    columns = ["µs a query", "p50", "p90", "p99", "p99.9", "largest", "queries/s", "above floor"]
    if state != "idle":
        columns += ["p50/idle", "p99/idle"]
    rows = []
    for key, row in results.rows.items():
        if not (runs := row.runs.get(state)):
            continue
        all_runs = median(runs)
        figures = (all_runs.p50, all_runs.p90, all_runs.p99, all_runs.p999, all_runs.largest)
        cells = [
            row.label,
            *map(_time, figures),
            f"{all_runs.per_second:,.0f}",
            _time(above_floor(results, key, state)),
        ]
        if state != "idle":
            idle = row.runs.get("idle")
            cells += [_ratio(paired(runs, idle, figure, figure)) for figure in (p50, p99)]
        rows.append(tuple(cells))
    title = f"{WHEN[state]}: medians of {results.runs} runs, largest of all; above floor: p50 minus the echo's p50"
    return Grid(title, tuple(columns), rows)


def loops(results: Results) -> Grid:
    """Return late answers of the control loop, on the model and on the echo."""
    columns = (
        "1 kHz WebSocket loop",
        "ticks",
        "late",
        "late %",
        "longest run",
        "p50 ms",
        "p99 ms",
        "p99.9 ms",
        "largest ms",
    )
    rows = []
    for state, pair in results.loops.items():
        rows += [_loop(f"model, {state}", pair.asked), _loop(f"echo, {state}", pair.floor)]
        difference = 100 * excess(pair.asked, pair.floor)
        rows.append((f"difference, {state}", "", "", f"{difference:+.3f}", "", "", "", "", ""))
        own = f"{100 * pair.server_late / pair.asked.ticks:.3f}"
        rows.append((f"service's own count, {state}", "", str(pair.server_late), own, "", "", "", "", ""))
    return Grid(f"late: the answer came more than {DEADLINE_MS:g} ms after its tick", columns, rows)


def motions(results: Results) -> Grid:
    """Return size and latency of the models of several training motions."""
    columns = (
        *("trained on", "samples", "inducing outputs", "inducing samples", "mean error max", "std error max"),
        *("mean only µs", "with std µs", "batch µs"),
    )
    rows = []
    for row in results.motions:
        sizes = [_whole(row.compact.get(name)) for name in ("inducing_outputs", "inducing_samples")]
        off = [_percent(row.compact.get(name)) for name in ("mean_max", "std_max")]
        times = [_time(value) for value in (row.mean, row.std, row.batch)]
        rows.append((row.motion, str(row.samples), *sizes, *off, *times))
    return Grid("training motions: p50 in process, idle", columns, rows)


def targets_grid(found: Sequence[Target], heading: str = "medians over runs") -> Grid:
    """Return targets and measured values; heading: of the column of names."""
    verdicts = {True: "met", False: "NOT met", None: ""}
    rows = []
    for each in found:
        measured = "not measured" if each.value is None else f"{_figure(each.value)} {each.unit}"
        limit = "" if each.limit is None else f"{each.sense} {each.limit:g} {each.unit}"
        rows.append((each.name, limit, measured, verdicts[each.met]))
    return Grid("targets", (heading, "target", "measured", ""), rows)


def show(results: Results, console: Console) -> None:
    """Print all tables and notes, at most WIDTH columns wide."""
    show_grids(grids(results), results.notes, console)


def show_grids(found: Sequence[Grid], notes: Sequence[str], console: Console) -> None:
    """Print tables and notes, at most WIDTH columns wide."""
    width = min(WIDTH, console.width)
    for grid in found:
        console.print(grid.rich(), width=width, soft_wrap=False)
    for note in notes:
        console.print(Text(f"- {note}"), width=width, soft_wrap=False)


def markdown(results: Results) -> str:
    """Return all tables and notes as Markdown."""
    return grids_markdown(grids(results), results.notes)


def grids_markdown(found: Sequence[Grid], notes: Sequence[str]) -> str:
    """Return tables and notes as Markdown."""
    listed = "\n".join(f"- {note}" for note in notes)
    return "\n\n".join([*(grid.markdown() for grid in found), *([listed] if listed else [])]) + "\n"


def _loop(name: str, loop: Loop) -> tuple[str, ...]:
    counts = (str(loop.ticks), str(loop.misses), f"{100 * loop.share:.3f}", str(loop.longest_cluster))
    delays = tuple(f"{value:.2f}" for value in (loop.p50, loop.p99, loop.p999))
    return (name, *counts, *delays, " ".join(f"{value:.1f}" for value in loop.largest))


def _cells(texts: Sequence[str]) -> str:
    return "| " + " | ".join(text.replace("|", "\\|") for text in texts) + " |"


def _time(value: float | None) -> str:
    if value is None:
        return NOTHING
    return f"{value:,.1f}" if abs(value) < 100 else f"{value:,.0f}"


def _figure(value: float) -> str:
    if value == 0 or not np.isfinite(value):
        return f"{value:g}"
    if abs(value) < 1e-3:
        return f"{value:.1e}"
    return f"{value:.3f}" if abs(value) < 1 else _time(value) if abs(value) >= 10 else f"{value:.2f}"


def _ratio(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.2f}"


def _whole(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.0f}"


def _percent(value: float | None) -> str:
    return NOTHING if value is None else f"{100 * value:.2f} %"

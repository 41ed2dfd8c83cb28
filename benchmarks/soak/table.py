"""Tables and targets of the load."""

from __future__ import annotations

import numpy as np

from benchmarks.latency.table import NOTHING, Grid, targets_grid
from benchmarks.latency.targets import Target
from benchmarks.soak.accounting import Account
from benchmarks.soak.resources import growth
from benchmarks.soak.running import Results

MAX_GROWTH = 5.0
"""Max growth of memory, percent."""
MAX_DIFFERENCE = 1e-8


def targets(results: Results) -> list[Target]:
    """Return all targets."""
    accounts = results.before, results.after
    grown = growth(results.service)
    below = growth(results.children)
    return [
        Target("failed exchanges", results.failed, "", "≤", 0),
        Target("acknowledged writes lost", sum(each.lost for each in accounts), "", "≤", 0),
        Target("stored, but not as acknowledged", sum(each.changed for each in accounts), "", "≤", 0),
        Target("stored, but never acknowledged", sum(each.surplus for each in accounts), "", "≤", 0),
        Target("batches learnt twice", results.after.twice, "", "≤", 0),
        Target(
            "largest difference from learning at once",
            max(each.difference for each in accounts),
            "relative",
            "≤",
            MAX_DIFFERENCE,
        ),
        Target("memory of the service, growth", None if grown is None else 100 * grown.share, "%", "≤", MAX_GROWTH),
        Target("memory of its learner, growth (no target)", None if below is None else 100 * below.share, "%"),
    ]


def grids(results: Results) -> list[Grid]:
    """Return all tables with rows, in order."""
    found = [
        Grid("machine", ("", ""), list(results.facts.items()), texts=True),
        Grid("model", ("", ""), list(results.model.items()), texts=True),
        _exchanges(results),
        _errors(results),
        _memory(results),
        _account(results),
        targets_grid(targets(results), ""),
    ]
    return [grid for grid in found if grid.rows]


def _exchanges(results: Results) -> Grid:
    rows = []
    for kind, timing in results.timings.items():
        figures = (timing.p50, timing.p99, timing.largest)
        each = (f"{value / 1e3:,.1f}" for value in figures)
        count = getattr(results.mix, kind)
        wrong = sum(results.errors[kind].values())
        rows.append(
            (kind, str(count), f"{timing.count:,}", f"{timing.count / results.seconds:,.0f}", *each, str(wrong))
        )
    columns = ("", "connections", "exchanges", "exchanges/s", "p50 ms", "p99 ms", "largest ms", "errors")
    return Grid(f"{results.mix.total} connections for {results.seconds:g} s", columns, rows)


def _errors(results: Results) -> Grid:
    rows = [(kind, text, str(count)) for kind, found in results.errors.items() for text, count in found.items()]
    return Grid("errors", ("", "", "times"), rows, texts=True)


def _memory(results: Results) -> Grid:
    rows = []
    for name, looks in (("service", results.service), ("its learner", results.children)):
        if looks:
            parts = [float(np.median(part)) for part in np.array_split(looks, 4) if len(part)]
            rows.append((name, *(f"{value:,.0f}" for value in parts), f"{max(looks):,.0f}"))
    columns = ("MiB, median of", "first quarter", "second", "third", "last", "largest")
    return Grid("memory written under load", columns, [row for row in rows if len(row) == len(columns)])


def _account(results: Results) -> Grid:
    names = {
        "batches": "batches acknowledged",
        "rows": "rows accepted",
        "datasets": "data sets uploaded",
        "deleted": "data sets deleted",
        "unsure": "writes without an answer",
        "lost": "lost",
        "changed": "stored, but not as acknowledged",
        "surplus": "stored, but never acknowledged",
        "twice": "repeated batches learnt twice",
    }
    rows = [(label, _count(results.before, name), _count(results.after, name)) for name, label in names.items()]
    rows.append(("difference of torques", f"{results.before.difference:.1e}", f"{results.after.difference:.1e}"))
    return Grid("writes", ("", "after the load", "after a restart"), rows)


def _count(account: Account, name: str) -> str:
    value = getattr(account, name)
    return f"{value:,}" if isinstance(value, int) else NOTHING

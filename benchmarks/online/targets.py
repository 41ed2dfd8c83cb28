"""Targets of online learning, and whether a run met them."""

from __future__ import annotations

from benchmarks.latency.targets import Target
from benchmarks.online.asking import LoopFigures
from benchmarks.online.results import Results

LEARNING, ADAPTING, REFIT = "learn", "adapt", "refit"
"""Keys of methods with targets."""


def targets(results: Results) -> list[Target]:
    """Return all targets, in the order of the table."""
    burst, last = results.burst, results.moments[-1] if results.moments else ""
    learnt = None if burst is None else burst.learnt
    return [
        Target("rows learnt per second, with a 500 Hz control loop", learnt, "/s", "≥", 5000),
        Target("prediction p99 while learning in real time / idle", tail(results, results.learning), "×", "≤", 3),
        Target("the same while rows are pushed (no target)", tail(results, results.pushed), "×"),
        Target("growth of the cost of a sample", growth(results), "%", "≤", 20),
        Target(f"nMSE {last}, adapting / full refit", relative(results, ADAPTING), "×", "≤", 1.2),
        Target("the same without adapting (no target)", relative(results, LEARNING), "×"),
        Target(f"{results.robots} robots merged: difference from all at once", results.merged, "relative", "≤", 1e-8),
    ]


def tail(results: Results, learning: LoopFigures | None) -> float | None:
    """Return p99 of answers while the model learns over p99 while idle."""
    if results.idle is None or learning is None:
        return None
    return learning.answers.p99 / results.idle.answers.p99


def growth(results: Results) -> float | None:
    """Return the largest over the smallest cost of a sample, minus 1, %."""
    if not results.costs:
        return None
    found = [cost.learn for cost in results.costs]
    return 100 * (max(found) / min(found) - 1)


def relative(results: Results, key: str) -> float | None:
    """Return mean nMSE at the last moment over that of the full refit."""
    one, refit = results.methods.get(key), results.methods.get(REFIT)
    if one is None or refit is None:
        return None
    last = results.moments[-1]
    return one.found[last].mean_nmse / refit.found[last].mean_nmse

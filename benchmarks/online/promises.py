"""What learning while serving promises, and whether this run saw it."""

from __future__ import annotations

from benchmarks.latency.targets import Target
from benchmarks.online.asking import Asked
from benchmarks.online.results import Results

LEARNING, ADAPTING, REFIT = "learn", "adapt", "refit"
"""Keys of methods that promises are about."""


def targets(results: Results) -> list[Target]:
    """Every promise about learning, in the order of the table."""
    burst, last = results.burst, results.moments[-1] if results.moments else ""
    learnt = None if burst is None else burst.learnt
    return [
        Target("rows learnt a second, beside a 500 Hz loop that asks", learnt, "/s", "≥", 5000),
        Target("prediction p99 while learning in real time / idle", tail(results, results.learning), "×", "≤", 3),
        Target("the same while rows are pushed (not promised)", tail(results, results.pushed), "×"),
        Target("cost of a sample: the largest above the smallest", growth(results), "%", "≤", 20),
        Target(f"nMSE {last}, adapting / full refit", relative(results, ADAPTING), "×", "≤", 1.2),
        Target("the same, learning on (not promised)", relative(results, LEARNING), "×"),
        Target(f"{results.robots} robots merged, against all at once", results.merged, "relative", "≤", 1e-8),
    ]


def tail(results: Results, learning: Asked | None) -> float | None:
    """How many times longer the 99th percentile of an answer takes while the model learns."""
    if results.idle is None or learning is None:
        return None
    return learning.answers.p99 / results.idle.answers.p99


def growth(results: Results) -> float | None:
    """By how much the cost of learning one sample varies with how many have been seen, %."""
    if not results.costs:
        return None
    found = [cost.learn for cost in results.costs]
    return 100 * (max(found) / min(found) - 1)


def relative(results: Results, key: str) -> float | None:
    """Mean nMSE at the last moment, relative to that of the full refit."""
    one, refit = results.methods.get(key), results.methods.get(REFIT)
    if one is None or refit is None:
        return None
    last = results.moments[-1]
    return one.found[last].mean_nmse / refit.found[last].mean_nmse

"""Throughput of large batches of states in process, beside Pinocchio in a Python loop."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console

from benchmarks import facts
from benchmarks.latency.baselines import rnea
from benchmarks.latency.table import Grid
from benchmarks.timing import Ask
from benchmarks.workload import simulator
from lipcore.files.persistence import load

BASELINE_STATES = 1000
"""States of a Python loop in one repetition."""


@dataclass
class Results:
    """CPU and elapsed time of each subject by batch size, best of all repetitions, µs a state."""

    machine: dict[str, str]
    deviation: float
    """Largest deviation of the mean alone from the prediction, relative to the largest torque."""
    times: dict[str, dict[int, tuple[float, float]]] = field(default_factory=dict)


def run(folder: Path, sizes: list[int], repetitions: int, console: Console) -> Results:
    """Measure the model in a folder."""
    model, robot = load(folder), simulator(folder)
    limits, rng = model.training_range, np.random.default_rng(0)
    low, high = (np.array([limits[name][end] for name in ("q", "dq", "ddq")])[:, None] for end in ("min", "max"))
    states = low + (high - low) * rng.random((3, max(sizes), model.n_joints))
    expected = model.predict(*states).mean
    deviation = float(np.abs(model.torque(*states) - expected).max() / np.abs(expected).max())
    results = Results(facts.machine(), deviation)
    for size in sizes:
        q, dq, ddq = (np.ascontiguousarray(each) for each in states[:, :size])
        console.print(f"{size:,} states", highlight=False)
        subjects: dict[str, tuple[Callable[[], object], int]] = {
            "torque": (partial(model.torque, q, dq, ddq), size),
            "torque and std": (partial(model.predict, q, dq, ddq), size),
        }
        if robot is not None:
            count = min(size, BASELINE_STATES)
            ask = rnea(robot, states[:, :count].swapaxes(0, 1))
            subjects["Pinocchio's rnea, Python loop"] = partial(_loop, ask, count), count
        for name, (work, count) in subjects.items():
            cpu, elapsed = np.min([_time(work) for _ in range(repetitions)], axis=0) / count
            results.times.setdefault(name, {})[size] = float(cpu), float(elapsed)
    return results


def grids(results: Results) -> list[Grid]:
    """Return all tables."""
    rows = [
        (name, f"{size:,}", f"{cpu:.2f}", f"{elapsed:.2f}", f"{1e6 / cpu:,.0f}")
        for name, of_name in results.times.items()
        for size, (cpu, elapsed) in of_name.items()
    ]
    columns = ("", "states", "CPU, µs a state", "elapsed, µs a state", "states a second of one CPU")
    return [
        Grid("machine", ("", ""), list(results.machine.items()), texts=True),
        Grid("batches in process, float64", columns, rows),
        Grid("largest deviation", ("", ""), [("torque, relative to the largest", f"{results.deviation:.1e}")]),
    ]


def _loop(ask: Ask, count: int) -> None:
    for number in range(count):
        ask(number)


def _time(work: Callable[[], object]) -> tuple[float, float]:
    """Return the CPU time of all threads and the elapsed time, µs."""
    cpu, elapsed = time.process_time(), time.perf_counter()
    work()
    return 1e6 * (time.process_time() - cpu), 1e6 * (time.perf_counter() - elapsed)

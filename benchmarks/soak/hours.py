"""`python -m benchmarks soak`: hours of a busy arm, replayed as fast as possible; no resource may grow."""

from __future__ import annotations

import json
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import httpx
from matplotlib.figure import Figure
from rich.console import Console

import lipcore
from benchmarks import facts
from benchmarks.latency.table import Grid, targets_grid
from benchmarks.latency.targets import Target
from benchmarks.online.bed import install, serving, train
from benchmarks.online.scene import Scene
from benchmarks.soak import day as days
from benchmarks.soak import errands
from benchmarks.soak.day import ARM, LOOP, Clock, Day, Tally
from benchmarks.soak.errands import ERRANDS, SLOW, Desk
from benchmarks.soak.resources import WARM_UP_SHARE, Growth, Look, ResourceWatch, growth, series
from lipcore.warm_up import warm_up
from service.api.access import keys
from service.contract.observations import LearningOptions
from service.storage.database import Database

MOTION_S = 600.0
"""Length of the arm's motion, which is repeated all day."""
SETTINGS = {"keys": "on", "max_loaded_models": 8}
"""Settings of the service."""
RETAINED_S, ROW_BYTES = 2400, 250
"""Retention of the loop's log, less than a tenth of eight hours, and the approximate size of a row."""
LEARNING = LearningOptions(on_change="learn")
FIT = {"posterior_samples": 500, "search_seconds": 10.0}
MAX_MEMORY_GROWTH, MAX_DISK_GROWTH = 5.0, 5.0
"""Max growth in percent, of the regression line after the first tenth."""
MAX_MORE_DESCRIPTORS, MAX_MORE_THREADS, MAX_MORE_PROCESSES = 3.0, 2.0, 0.5
"""Max increase, of the regression line after the first tenth."""
UNITS = {
    "service": "memory of the service, MiB",
    "learner": "memory of its learner, MiB",
    "jobs": "memory of training processes, MiB",
    "descriptors": "descriptors of both",
    "threads": "threads of both",
    "processes": "processes below the service",
    "disk": "disk of the home, MiB",
}


@dataclass(frozen=True)
class Options:
    """Scope of the benchmark.

    Attributes:
        hours: hours of the arm.
        rate: rate of the observations, Hz.
        minutes: max duration of the benchmark.
        seed: seed of the motion.
    """

    hours: float = 8.0
    rate: int = 100
    minutes: float | None = None
    seed: int = 0


@dataclass
class Results:
    """All figures of a day.

    Attributes:
        facts: machine and packages.
        hours: hours of the arm.
        seconds: duration of the benchmark.
        done: count of each step.
        errors: count of each error.
        looks: resources of the service over time.
        unasked: routes without a request.
    """

    facts: dict[str, str]
    hours: float
    seconds: float = 0.0
    done: dict[str, int] = field(default_factory=dict)
    errors: dict[str, int] = field(default_factory=dict)
    looks: list[Look] = field(default_factory=list)
    unasked: list[str] = field(default_factory=list)

    def write(self, path: Path, found: list[dict[str, Any]]) -> None:
        """Write all figures as JSON."""
        path.write_text(json.dumps({**asdict(self), "targets": found}, indent=2) + "\n")


def run(options: Options, console: Console) -> Results:
    """Run the benchmark; raise BenchError if a step fails."""
    scene = Scene("panda", rate=float(options.rate), seed=options.seed)
    results = Results(facts.machine(), options.hours)
    with tempfile.TemporaryDirectory(prefix="lipserve-bench-") as name:
        folder = Path(name)
        home = folder / "home"
        console.print("training a model of panda", highlight=False)
        warm_up("rigid-body")  # a process that compiles keeps 30 MiB of compiler memory
        base, _ = train(scene.history(50.0, 10.0), scene.arm.joint_types, FIT, "rigid-body")
        lipcore.save(base, folder / "model")
        install(home, folder / "model", {ARM: LEARNING, LOOP: LEARNING}, base.n_joints)
        with closing(Database(home)) as database:
            _, key = keys.create(database, "soak", ["admin"], None, max_requests_per_s=1e6)
        clock = Clock(round(3600 * options.hours))
        samples = scene.more(MOTION_S)
        retained = {"observation_retention_bytes": RETAINED_S * days.FRAMES * ROW_BYTES}
        with serving(home, {**SETTINGS, **retained}) as bed:
            day = Day(clock, Tally(), bed.tcp, bed.client.url, key, samples, options.rate)
            began = time.monotonic()
            http = httpx.Client(base_url=day.url, headers=day.headers, timeout=120.0)
            with http, ResourceWatch(bed.pid, home, lambda: float(clock.now)) as watch:
                desk = Desk(day, http, home, folder, scene, [])
                _work(desk, options.minutes, console)
                results.hours = clock.now / 3600
                results.unasked = errands.unasked(desk)
            results.seconds, results.looks = time.monotonic() - began, watch.looks
        results.done, results.errors = dict(day.tally.done.most_common()), dict(day.tally.errors)
    return results


def _work(desk: Desk, minutes: float | None, console: Console) -> None:
    """Run all tasks until the day is over."""
    day = desk.day
    work = [partial(each, day) for each in (days.teach, days.ask, days.loop)]
    work += [partial(errands.run, desk, period, each) for period, each in ERRANDS.items()]
    work += [partial(errands.run, desk, period, each, False) for period, each in SLOW.items()]
    threads = [threading.Thread(target=each, daemon=True) for each in work]
    began = time.monotonic()
    for thread in threads:
        thread.start()
    known: set[str] = set()
    while any(thread.is_alive() for thread in threads):
        for thread in threads:
            thread.join(30.0 / len(threads))
        seconds = time.monotonic() - began
        console.print(f"{seconds:.0f} s: {day.clock.now / 3600:.2f} hours of the arm", highlight=False)
        for text in day.tally.errors.keys() - known:
            console.print(text, highlight=False, markup=False)
            known.add(text)
        if minutes is not None and seconds > 60 * minutes:
            day.clock.end()


def targets(results: Results) -> list[Target]:
    """Return all targets."""
    at = series(results.looks, "at")
    lines = {name: growth(series(results.looks, name), at) for name in UNITS}

    def share(line: Growth | None) -> float | None:
        return None if line is None else 100 * line.share

    def rise(line: Growth | None) -> float | None:
        return None if line is None else line.rise

    return [
        Target("failed requests and tasks", sum(results.errors.values()), "", "≤", 0),
        Target("routes without a request", len(results.unasked), "", "≤", 0),
        Target("memory of the service, growth", share(lines["service"]), "%", "≤", MAX_MEMORY_GROWTH),
        Target("memory of its learner, growth", share(lines["learner"]), "%", "≤", MAX_MEMORY_GROWTH),
        Target("memory of training processes, growth", share(lines["jobs"]), "%", "≤", MAX_MEMORY_GROWTH),
        Target("disk of the home, growth", share(lines["disk"]), "%", "≤", MAX_DISK_GROWTH),
        Target("descriptors, growth", rise(lines["descriptors"]), "", "≤", MAX_MORE_DESCRIPTORS),
        Target("threads, growth", rise(lines["threads"]), "", "≤", MAX_MORE_THREADS),
        Target("processes, growth", rise(lines["processes"]), "", "≤", MAX_MORE_PROCESSES),
    ]


def grids(results: Results) -> list[Grid]:
    """Return all tables with rows, in order."""
    found = [
        Grid("machine", ("", ""), list(results.facts.items()), texts=True),
        Grid(
            f"{results.hours:.3g} hours of a busy arm in {results.seconds / 60:.0f} minutes",
            ("", "times"),
            [(name, f"{count:,}") for name, count in results.done.items()],
        ),
        Grid("errors", ("", "times"), [(text, f"{count:,}") for text, count in results.errors.items()]),
        Grid("routes without a request", ("",), [(route,) for route in results.unasked]),
        _resources(results),
        targets_grid(targets(results), ""),
    ]
    return [grid for grid in found if grid.rows]


def _resources(results: Results) -> Grid:
    """Return the median of each resource in each fifth after the first tenth."""
    end = results.looks[-1].at if results.looks else 0.0
    edges = [end * (WARM_UP_SHARE + (1 - WARM_UP_SHARE) * fifth / 5) for fifth in range(6)]
    fifths = [[look for look in results.looks if a <= look.at <= b] for a, b in pairwise(edges)]
    rows = []
    for name, unit in UNITS.items():
        parts = [_median(series(fifth, name)) for fifth in fifths]
        rows.append((unit, *(f"{part:,.0f}" for part in parts), f"{max(series(results.looks, name), default=0):,.0f}"))
    columns = ("median of each fifth after the first tenth", "1", "2", "3", "4", "5", "largest")
    return Grid("resources", columns, rows if results.looks else [])


def _median(values: Sequence[float]) -> float:
    ordered = sorted(values)
    return ordered[len(ordered) // 2] if ordered else 0.0


def draw(results: Results, path: Path) -> None:
    """Draw memory, disk, descriptors and threads over the hours of the arm."""
    figure = Figure((8.0, 4.2), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    hours = [look.at / 3600 for look in results.looks]
    for name, label in (("service", "service"), ("learner", "learner"), ("jobs", "training"), ("disk", "disk")):
        above.plot(hours, series(results.looks, name), label=label, linewidth=0.8)
    for name in ("descriptors", "threads"):
        below.plot(hours, series(results.looks, name), label=name, linewidth=0.8)
    for axes, unit in ((above, "MiB"), (below, "number")):
        axes.axvspan(0.0, WARM_UP_SHARE * results.hours, color="0.9", linewidth=0)
        axes.set_ylim(bottom=0.0)
        axes.set_ylabel(unit)
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    below.set_xlabel("hours of the arm (grey: the first tenth)")
    figure.savefig(path, dpi=110)

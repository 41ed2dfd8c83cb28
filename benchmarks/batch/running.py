"""Throughput of batches of states in process, beside other libraries and on a device of PyTorch."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks import facts
from benchmarks.batch.on_device import on_device
from benchmarks.batch.peers import Peer, open_peers
from benchmarks.latency.table import NOTHING, Grid, targets_grid
from benchmarks.latency.targets import Target
from benchmarks.workload import simulator
from lipcore.data.samples import Array
from lipcore.files.persistence import load
from lipcore.model.torque_model import TorqueModel

PROCESSORS = 2
"""Processors of the targets."""
MIN_STATES = 1000
"""States of a measured stretch: small batches are computed several times."""
COMPARED = 1000
"""States on which torques are compared."""
MAX_S = 5.0
"""Time for the repetitions of a batch. The first two are always measured: one of them may compile code."""


@dataclass(frozen=True)
class Options:
    """Scope of the benchmark.

    Attributes:
        folder: folder of the model.
        sizes: states in a batch.
        repetitions: number of measurements; the best counts.
        eigen: folder of Eigen's headers, for Pinocchio in C++; None: those of CasADi's package.
        device: device of PyTorch that is measured too.
    """

    folder: Path
    sizes: tuple[int, ...]
    repetitions: int = 10
    eigen: Path | None = None
    device: str | None = None


@dataclass
class Results:
    """CPU and elapsed time of each subject by batch size, best of all repetitions, µs a state."""

    machine: dict[str, str]
    times: dict[str, dict[int, tuple[float, float]]] = field(default_factory=dict)
    deviations: dict[str, float] = field(default_factory=dict)
    """Largest deviation of a subject's torques from those it should equal, relative to the largest."""
    notes: list[str] = field(default_factory=list)

    def write(self, path: Path, targets: list[dict[str, Any]]) -> None:
        """Write all figures as JSON."""
        path.write_text(json.dumps({**asdict(self), "targets": targets}, indent=2) + "\n")


def run(options: Options, console: Console) -> Results:
    """Measure the model in a folder."""
    model, robot = load(options.folder), simulator(options.folder)
    states, results = draw_states(model, max(options.sizes)), Results(facts.machine())
    parameters: Any = json.loads((options.folder / "manifest.json").read_bytes()).get("parameters", {})
    with open_peers(model, parameters, robot, options.eigen) as (peers, notes):
        results.notes += notes
        for size in options.sizes:
            q, dq, ddq = batch = np.ascontiguousarray(states[:, :size])
            console.print(f"{size:,} states", highlight=False)
            _measure(results, options, "mean", size, size, partial(model.torque, q, dq, ddq))
            _measure(results, options, "with std", size, size, partial(model.predict, q, dq, ddq))
            for peer in peers:
                count = min(size, peer.max_states or size)
                _measure(results, options, peer.name, size, count, peer.prepare(batch[:, :count].copy()))
            if options.device is not None:
                for name, work in on_device(model, options.device, batch, options.device != "cpu"):
                    _measure(results, options, name, size, size, work)
        results.deviations = _deviations(model, peers, states[:, :COMPARED])
    return results


def grids(results: Results) -> list[Grid]:
    """Return all tables."""
    sizes = sorted({size for of_name in results.times.values() for size in of_name})
    columns = ("states in a batch", *(f"{size:,}" for size in sizes))
    tables = [
        Grid(
            f"states a second, {what}",
            columns,
            [
                (name, *(_rate(of_name[size][place]) if size in of_name else NOTHING for size in sizes))
                for name, of_name in results.times.items()
            ],
        )
        for place, what in enumerate(("by CPU time of all threads", "by elapsed time"))
    ]
    deviations = [(name, f"{value:.1e}") for name, value in results.deviations.items()]
    return [
        Grid("machine", ("", ""), list(results.machine.items()), texts=True),
        *tables,
        Grid("largest deviation of torques, relative to the largest", ("", ""), deviations),
        targets_grid(targets(results), ""),
    ]


def targets(results: Results) -> list[Target]:
    """Return the targets for an arm of seven joints on two processors, from the throughput of one."""
    best = {
        name: PROCESSORS * 1e6 / min(cpu for cpu, _ in results.times[name].values()) for name in ("mean", "with std")
    }
    return [
        Target(f"{name}: states a second of two processors", best[name], "", "≥", least)
        for name, least in (("mean", 2e6), ("with std", 3e5))
    ]


def draw_states(model: TorqueModel, count: int) -> Array:
    """Return random states of the training range, (3, N, n)."""
    limits, rng = model.training_range, np.random.default_rng(0)
    low, high = (np.array([limits[name][end] for name in ("q", "dq", "ddq")])[:, None] for end in ("min", "max"))
    return np.asarray(low + (high - low) * rng.random((3, count, model.n_joints)))


def _deviations(model: TorqueModel, peers: Sequence[Peer], states: Array) -> dict[str, float]:
    """Compare the mean with the prediction, and RNEA of a known arm with Pinocchio's."""
    found = {"mean, from the prediction's": (model.torque(*states), model.predict(*states).mean)}
    known = {peer.name: peer.prepare(states.copy())() for peer in peers if peer.knows_arm}
    for name, torques in list(known.items())[1:]:
        first = next(iter(known))
        found[f"{name}, from {first}"] = torques, known[first]
    return {name: float(np.abs(one - other).max() / np.abs(other).max()) for name, (one, other) in found.items()}


def _measure(results: Results, options: Options, name: str, size: int, count: int, work: Callable[[], object]) -> None:
    """Measure a call of `work`, which computes `count` states, as the time of a batch of `size`."""
    calls = max(1, MIN_STATES // count)
    times, end = list[tuple[float, float]](), time.perf_counter() + MAX_S
    while len(times) < 2 or (len(times) < options.repetitions and time.perf_counter() < end):
        times.append(_time(work, calls))
    cpu, elapsed = np.min(times, axis=0) / (calls * count)
    results.times.setdefault(name, {})[size] = float(cpu), float(elapsed)


def _time(work: Callable[[], object], calls: int) -> tuple[float, float]:
    """Return the CPU time of all threads and the elapsed time, µs."""
    cpu, elapsed = time.process_time(), time.perf_counter()
    for _ in range(calls):
        work()
    return 1e6 * (time.process_time() - cpu), 1e6 * (time.perf_counter() - elapsed)


def _rate(time_us: float) -> str:
    """Return states a second with two digits, such as 2.1e6."""
    return f"{1e6 / max(time_us, 1e-9):.1e}".replace("e+0", "e")

"""Effect of the training motion on the size of a model and its latency."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

import lipcore
from benchmarks import facts
from benchmarks.latency.measuring import add_run
from benchmarks.latency.results import MotionRow, Results
from benchmarks.latency.subjects import Subject, in_process
from benchmarks.latency.targets import p50, single
from benchmarks.workload import TRAIN_SEED, Workload
from lipcore.data.samples import Samples
from lipcore.robots.library import Robot, load_robot
from lipcore.robots.simulation import FAST_SPEED, Simulation, simulate

SLOW, QUICK = Simulation(), Simulation(speed=FAST_SPEED)
MOTIONS: dict[str, tuple[Simulation, ...]] = {
    "slow": (SLOW,),
    "fast": (QUICK,),
    "slow and fast": (SLOW, QUICK),
    "full range, slow and fast": (Simulation(motion="full"), Simulation(motion="full", speed=FAST_SPEED)),
}
QUERIES = 1000


def compare(
    robot: str, fit: Mapping[str, Any], runs: int, home: Path, console: Console, queries: int = QUERIES
) -> list[MotionRow]:
    """Train a model on each kind of motion in this process and time all; return rows in the order of MOTIONS."""
    simulator, results = load_robot(robot), Results({}, {}, 0.0, runs, queries)
    found = {name: _train(name, simulator, streams, fit, home, console) for name, streams in MOTIONS.items()}
    asked = [_named(subject, name) for name, workload in found.items() for subject in in_process(workload)]
    for _ in range(runs):
        add_run(results, asked, "idle", queries)
    rows = []
    for name, workload in found.items():
        mean, std, batch = (single(results.of(f"{name}: {key}"), p50) or np.nan for key in ("mean", "std", "batch"))
        samples = int(workload.manifest["fit"]["samples_given"])
        rows.append(MotionRow(name, samples, facts.compact(workload.manifest), mean, std, batch))
    return rows


def _train(
    name: str, robot: Robot, streams: tuple[Simulation, ...], fit: Mapping[str, Any], home: Path, console: Console
) -> Workload:
    samples = Samples.concatenate([simulate(robot, stream, TRAIN_SEED) for stream in streams])
    model = lipcore.train(samples, robot.joint_types, "lip-chain", lipcore.FitOptions(**fit))
    folder = home / f"motion-{name.replace(' ', '-')}"
    manifest = lipcore.save(model, folder)
    console.print(f"  {name}: {json.dumps(manifest.get('compact', {}))}", highlight=False)
    return Workload.load(folder, robot, samples, streams[-1])


def _named(subject: Subject, name: str) -> Subject:
    return Subject(f"{name}: {subject.key}", subject.label, subject.ask, subject.queries, subject.share)

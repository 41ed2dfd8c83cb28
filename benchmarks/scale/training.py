"""Time and memory of training on sharded recordings."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.latency.table import NOTHING, Grid
from benchmarks.latency.targets import Target
from benchmarks.scale import streams
from benchmarks.scale.engines import Engines, ready
from benchmarks.scale.part import Part
from benchmarks.scale.peaks import Peaks
from benchmarks.workload import BenchError
from lipserve import Client
from lipserve.states import ACTIVE, SUCCEEDED

NAME = "train"
TARGET_ROWS = 1_000_000
"""Samples of the job that the target of time is about."""
MAX_SECONDS, MAX_MIB, MAX_COST_RATIO = 15 * 60.0, 2048.0, 1.2
_POLL_S = 0.2


@dataclass(frozen=True)
class Trained:
    """Figures of one job.

    Attributes:
        rows: number of samples.
        shards: number of shards.
        upload_s: time of the uploads.
        seconds: time from the request to the end of the job.
        stages: seconds of each stage.
        peaks: peak memory of a process, MiB.
        standing: samples in its posterior.
        inducing: outputs of its basis; the cost of a sample grows with their square.
    """

    rows: int
    shards: int
    upload_s: float
    seconds: float
    stages: dict[str, float] = field(default_factory=dict)
    peaks: dict[str, float] = field(default_factory=dict)
    standing: int = 0
    inducing: int = 0

    @property
    def summing_us(self) -> float | None:
        """Time a sample of the pass over all samples, µs; None without such a pass."""
        seconds = self.stages.get("statistics")
        return None if not seconds else 1e6 * seconds / self.rows


def run(engines: Engines, sizes: Sequence[int], fit: Mapping[str, Any], seed: int, console: Console) -> Part:
    """Train on recordings of each size, each on a new service with as many statistics processes as CPUs."""
    found = [_train(engines, rows, fit, seed, console) for rows in sizes]
    return Part(NAME, {"jobs": [asdict(each) for each in found]}, [_grid(found)], _targets(found))


def _train(engines: Engines, rows: int, fit: Mapping[str, Any], seed: int, console: Console) -> Trained:
    cpus = os.cpu_count() or 1
    service = engines.alone({"statistics_workers": cpus, "training_cpus": cpus})
    folder = engines.home("shards")
    folder.mkdir()
    with ready(service) as client, Peaks(service.process.pid) as peaks:
        console.print(f"uploading {rows:,} simulated samples as Parquet", highlight=False)
        datasets, upload_s = [], 0.0
        for path in streams.shards(folder, rows, seed):
            began = time.monotonic()
            datasets.append(_upload(client, path))
            upload_s += time.monotonic() - began
            path.unlink()
        console.print("training", highlight=False)
        began = time.monotonic()
        types = list(streams.robot().joint_types)
        queued = client.train("bench", datasets, "lip-chain", types, fit, holdout={"only": True})  # one fit, one pass
        stages: dict[str, float] = {}
        while (job := client.job(queued.id)).state in ACTIVE:
            stages[job.progress.stage] = stages.get(job.progress.stage, 0.0) + _POLL_S
            time.sleep(_POLL_S)
        seconds = time.monotonic() - began
        peaks.note()
        if job.state != SUCCEEDED or job.version is None:
            raise BenchError(
                f"The training job has {job.state}: {job.error.message if job.error else 'no error given'}"
            )
        version = client.version("bench", job.version)
    service.stop()
    standing, inducing = int(version.fit["samples_posterior"]), int((version.compact or {})["inducing_outputs"])
    console.print(
        f"{seconds:.0f} s; a basis of {inducing} outputs, {standing:,} samples in the posterior", highlight=False
    )
    scale = seconds / max(sum(stages.values()), _POLL_S)  # polling takes time, too
    shares = {name: scale * value for name, value in stages.items()}
    return Trained(rows, len(datasets), upload_s, seconds, shares, dict(peaks.found), standing, inducing)


def _upload(client: Client, path: Path) -> str:
    return client.upload(path, joint_names=streams.robot().joint_names).id


def _grid(found: Sequence[Trained]) -> Grid:
    columns = ("samples", "shards", "upload s", "job s", "search s", "basis s", "pass s", "µs/sample", "outputs")
    rows = []
    for each in found:
        stages = (each.stages.get(stage) for stage in ("hyperparameters", "posterior", "statistics"))
        shown = (each.upload_s, each.seconds, *stages, each.summing_us)
        peaks = (each.peaks.get(kind) for kind in ("service", "training", "statistics"))
        rows.append((f"{each.rows:,}", str(each.shards), *map(_text, shown), str(each.inducing), *map(_text, peaks)))
    title = f"training on shards, {os.cpu_count()} statistics processes; last columns: peak memory of a process, MiB"
    return Grid(title, (*columns, "service", "training", "statistics"), rows)


def _targets(found: Sequence[Trained]) -> list[Target]:
    largest = max(found, key=lambda each: each.rows)
    seconds = largest.seconds if largest.rows >= TARGET_ROWS else None
    # divide by outputs², as each fit chooses another basis
    costs = [
        None if each.summing_us is None else each.summing_us / each.inducing**2
        for each in sorted(found, key=lambda each: each.rows)
    ]
    first, last = costs[0], costs[-1]
    ratio = None if len(found) < 2 or first is None or last is None else last / first
    memory = max((peak for each in found for peak in each.peaks.values()), default=None)
    return [
        Target(f"training on {TARGET_ROWS:,} samples of seven joints", seconds, "s", "<", MAX_SECONDS),
        Target("memory of a process", memory, "MiB", "<", MAX_MIB),
        Target("pass a sample and outputs², largest / smallest size", ratio, "×", "≤", MAX_COST_RATIO),
    ]


def _text(value: float | None) -> str:
    return NOTHING if value is None else f"{value:,.0f}" if value >= 100 else f"{value:.1f}"

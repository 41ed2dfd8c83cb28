"""Speed-up of the pass over all samples by a second process, and identity of its sum."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

import lipcore
from benchmarks.latency.table import Grid
from benchmarks.latency.targets import Target
from benchmarks.scale import streams
from benchmarks.scale.engines import Engines
from benchmarks.scale.part import Part
from lipcore.data.samples import Samples
from lipcore.posterior.summing import Summing
from lipcore.training.conditioning import SHARD, ShardStatistics, sum_samples
from service.foundation.settings import Settings, shipped_models
from service.runtime import executors
from service.runtime.executors import Processes, sum_shards

NAME = "pass"
MODEL = "panda-sim"
NAMES = ("t", "episode", "q", "dq", "ddq", "tau")
MIN_SPEEDUP = 1.7
LONGER, MAX_COST_RATIO = 5, 1.1
"""Factor on the number of samples, and max growth of the cost of a sample."""
POOL, CLUSTER = "processes of this host", "Dask workers"


@dataclass(frozen=True)
class Shard:
    """Rows of a recording in a folder with a file for each array."""

    model: str
    recording: str
    first: int
    last: int


def work(shard: Shard) -> ShardStatistics:
    """Return the statistics of a shard."""
    folder, rows = Path(shard.recording), slice(shard.first, shard.last)
    arrays = {name: np.array(np.load(folder / f"{name}.npy", mmap_mode="r")[rows]) for name in NAMES}
    summing, names = _summing(shard.model)
    return sum_samples(summing, Samples(names, **arrays), None)


@cache
def _summing(model: str) -> tuple[Summing, tuple[str, ...]]:
    loaded = lipcore.load(Path(model))
    return Summing.of(loaded.posterior), loaded.joint_names


def run(engines: Engines, rows: int, pairs: int, seed: int, console: Console) -> Part:
    """Sum up one recording repeatedly with one and two processes in turn, on this host and on a cluster."""
    shards = _shards(engines.home("recording"), rows, seed)
    seconds: dict[str, dict[int, list[float]]] = {}
    sums: set[str] = set()
    longer = float("nan")
    for kind, opened in ((POOL, _pools(engines)), (CLUSTER, _clusters(engines))):
        with opened as by_count:
            found = seconds[kind] = {count: [] for count in by_count}
            for executor in by_count.values():
                sum_shards(executor, work, shards[:2], _never)  # import modules, load the model
            for pair in range(pairs):
                for count in sorted(by_count, reverse=bool(pair % 2)):
                    began = time.monotonic()
                    total = sum_shards(by_count[count], work, shards, _never)
                    found[count].append(time.monotonic() - began)
                    sums.add(hashlib.sha256(total.a.tobytes() + total.b.tobytes()).hexdigest())
                one, two = found[1][-1], found[2][-1]
                console.print(f"{kind}: {one:.1f} s with one, {two:.1f} s with two", highlight=False)
            if kind == POOL:
                began = time.monotonic()
                sum_shards(by_count[2], work, LONGER * shards, _never)
                longer = time.monotonic() - began
    return _part(rows, seconds, longer, len(sums))


@contextmanager
def _pools(engines: Engines) -> Iterator[Mapping[int, Executor]]:
    home = engines.home("pool")
    found = {count: Processes(Settings(home=home, statistics_workers=count)) for count in (1, 2)}
    try:
        yield found
    finally:
        for each in found.values():
            each.shutdown(wait=False, cancel_futures=True)


@contextmanager
def _clusters(engines: Engines) -> Iterator[Mapping[int, Executor]]:
    workers = [engines.worker(), engines.worker()]
    engines.wait_workers(len(workers))
    client = executors.connect(engines.scheduler)
    try:
        names = sorted(client.scheduler_info(n_workers=-1)["workers"])
        wanted: dict[str, Any] = {"resources": {executors.SHARD: 1}, "pure": False}
        yield {count: client.get_executor(workers=names[:count], **wanted) for count in (1, 2)}
    finally:
        client.close()
        for worker in workers:
            worker.terminate()
        for worker in workers:
            worker.wait(30)


def _shards(folder: Path, rows: int, seed: int) -> list[Shard]:
    folder.mkdir()
    samples = streams.stream(rows, seed + 20)
    for name in NAMES:
        np.save(folder / f"{name}.npy", getattr(samples, name))
    model = str(shipped_models() / MODEL)
    return [Shard(model, str(folder), first, min(first + SHARD, rows)) for first in range(0, rows, SHARD)]


def _part(rows: int, seconds: Mapping[str, Mapping[int, list[float]]], longer: float, sums: int) -> Part:
    table, targets = [], []
    for kind, found in seconds.items():
        ratio = float(np.median(np.array(found[1]) / np.array(found[2])))
        for count, times in found.items():
            rate = rows / float(np.median(times))
            table.append((kind, str(count), f"{rate:,.0f}", f"{min(times):.1f}", f"{max(times):.1f}"))
        table.append((f"{kind}: median ratio of pairs", "", f"{ratio:.2f}", "", ""))
        targets.append(Target(f"speed-up by a second process, {kind}", ratio, "×", "≥", MIN_SPEEDUP))
    table.append((f"{POOL}: {LONGER * rows:,} samples", "2", f"{LONGER * rows / longer:,.0f}", f"{longer:.1f}", ""))
    ratio = longer / LONGER / float(np.median(seconds[POOL][2]))
    targets.append(Target(f"cost of a sample with {LONGER} times as many", ratio, "×", "≤", MAX_COST_RATIO))
    targets.append(Target("different sums", sums, "", "≤", 1))
    columns = ("", "processes", "samples/s", "fastest s", "slowest s")
    title = f"pass over {rows:,} samples of seven joints in shards of {SHARD:,}, model {MODEL}"
    figures = {
        "rows": rows,
        "seconds": {kind: dict(found) for kind, found in seconds.items()},
        "longer_s": longer,
        "sums": sums,
    }
    return Part(NAME, figures, [Grid(title, columns, table)], targets)


def _never() -> bool:
    return False

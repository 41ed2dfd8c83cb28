"""The benchmark of several services from options to results."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks import facts
from benchmarks.scale import cancelling, costs, faults, passes, replicas, training
from benchmarks.scale.engines import started
from benchmarks.scale.part import Part, Results

PARTS = (passes.NAME, training.NAME, replicas.NAME, cancelling.NAME, costs.NAME, faults.NAME)
"""Names of all parts."""


@dataclass(frozen=True)
class Options:
    """Scope of the benchmark.

    Attributes:
        sizes: samples of the training jobs.
        fit: fit options of the training jobs.
        pass_rows: samples of a pass over all.
        pairs: passes with one and with two processes.
        trials: trials with two services.
        cancels: number of cancelled jobs.
        batches: batches of each size.
        queries: timed queries.
        kills: faults of each kind.
        seed: seed of all random numbers.
        only: names of parts; empty: all.
    """

    sizes: tuple[int, ...] = (200_000, 1_000_000)
    fit: Mapping[str, Any] = field(default_factory=dict)
    pass_rows: int = 24_576
    pairs: int = 5
    trials: int = 20
    cancels: int = 5
    batches: int = 200
    queries: int = 5000
    kills: int = 5
    seed: int = 0
    only: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if unknown := [name for name in self.only if name not in PARTS]:
            raise ValueError(f"Unknown name {unknown[0]!r} in --only. Names: {', '.join(PARTS)}.")


QUICK = {
    "sizes": (4_000, 8_000),
    "fit": {"hyperparameter_samples": 60, "posterior_samples": 200, "max_iterations": 20, "starts": 1},
    "pass_rows": 16_384,
    "pairs": 2,
    "trials": 3,
    "cancels": 1,
    "batches": 20,
    "queries": 500,
    "kills": 1,
}
"""Options of `--quick`."""


def run(options: Options, console: Console) -> Results:
    """Run the benchmark; raise BenchError if a step fails."""
    results = Results(facts.machine())
    with tempfile.TemporaryDirectory(prefix="lipserve-bench-") as folder, started(Path(folder)) as engines:
        seed = options.seed
        measured: dict[str, Callable[[], Part]] = {
            passes.NAME: lambda: passes.run(engines, options.pass_rows, options.pairs, seed, console),
            training.NAME: lambda: training.run(engines, options.sizes, options.fit, seed, console),
            replicas.NAME: lambda: replicas.run(engines, options.trials, seed, console),
            cancelling.NAME: lambda: cancelling.run(engines, options.cancels, seed, console),
            costs.NAME: lambda: costs.run(engines, options.batches, options.queries, seed, console),
            faults.NAME: lambda: faults.run(engines, options.kills, seed, console),
        }
        for name, measure in measured.items():
            if not options.only or name in options.only:
                console.print(f"[bold]{name}[/bold]")
                results.parts.append(measure())
    return results

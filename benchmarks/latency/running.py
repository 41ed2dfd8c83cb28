"""The latency benchmark from options to results."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console

from benchmarks import facts, processor
from benchmarks.latency import motions, subjects, transports
from benchmarks.latency.loop import DEADLINE_MS
from benchmarks.latency.measuring import add_run, control_loop
from benchmarks.latency.results import Results, State
from benchmarks.latency.subjects import Subject
from benchmarks.load import TrainingLoad
from benchmarks.processor import Usage, watched
from benchmarks.workload import Bed, Source, open_bed

LOOP = "loop"
KEYS = (*("mean", "std", "batch"), *transports.KEYS, *("rnea", "exact", "gpytorch", "gpytorch-fast"), LOOP)
"""Names of all subjects."""


@dataclass(frozen=True)
class Options:
    """Scope of the benchmark.

    Attributes:
        runs: runs of every subject in every state.
        queries: queries a run, fewer for slow subjects.
        seconds: length of the control loop, on the model and on the echo each.
        training: measure also while a training job runs.
        motions: compare models of several kinds of motion, too.
        only: names out of KEYS; empty: all.
    """

    source: Source = field(default_factory=Source)
    runs: int = 5
    queries: int = 4000
    seconds: float = 60.0
    training: bool = True
    motions: bool = False
    only: tuple[str, ...] = ()

    @property
    def states(self) -> list[State]:
        """The states to measure in."""
        return ["idle", "training"] if self.training else ["idle"]

    def __post_init__(self) -> None:
        if unknown := [name for name in self.only if name not in KEYS]:
            raise ValueError(f"Unknown name {unknown[0]!r} in --only. Names: {', '.join(KEYS)}.")

    def is_wanted(self, name: str) -> bool:
        """Return whether a subject is measured, by itself or as the floor of another."""
        return not self.only or name in self.only or name in transports.floors(self.only, LOOP)


def run(options: Options, console: Console) -> Results:
    """Run the benchmark; raise BenchError if a step fails or an answer is wrong."""
    machine = facts.machine()
    with ExitStack() as stack:
        home = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lipserve-bench-")))
        bed = stack.enter_context(open_bed(home, options.source, console))
        machine["threads of this process"] = stack.enter_context(facts.one_thread())
        manifest = bed.workload.manifest
        model, deviation = facts.model(manifest, _describe_source(options)), facts.deviation(manifest)
        results = Results(machine, model, deviation, options.runs, options.queries)
        load = TrainingLoad(bed, options.source.load)
        stack.callback(load.stop)
        asked = _subjects(bed, options, results, stack)
        _runs(bed, asked, load, options, results, console)
        if options.is_wanted(LOOP) and options.seconds > 0:
            _loop(bed, asked, load, options, results, console, stack)
        results.rows = {key: results.rows[key] for key in KEYS if key in results.rows}
        results.notes += load.notes()
        if options.motions:
            console.print("training models of four kinds of motion")
            results.motions = motions.compare(options.source.robot, options.source.fit, options.runs, home, console)
    return results


def _subjects(bed: Bed, options: Options, results: Results, stack: ExitStack) -> list[Subject]:
    """Return all wanted subjects, their answers checked; `stack` closes their connections."""
    found = subjects.in_process(bed.workload) + transports.open_all(bed, options.is_wanted, stack)
    baselines, notes, results.unseen = subjects.make_baselines(bed.workload, options.is_wanted)
    chosen = [subject for subject in [*found, *baselines] if options.is_wanted(subject.key)]
    for subject in chosen:
        subject.check(bed.workload)
    results.notes += [transports.NOTE, *notes]
    return chosen


def _runs(
    bed: Bed, asked: Sequence[Subject], load: TrainingLoad, options: Options, results: Results, console: Console
) -> None:
    usage = {state: Usage() for state in options.states}
    for number in range(1, options.runs + 1):
        for state in options.states:
            console.print(f"run {number} of {options.runs}, {state}", highlight=False)
            with watched(usage[state], bed.pid):
                add_run(results, asked, state, options.queries, load if state == "training" else None)
            load.stop()
    _note_usage(results, {f"runs, {state}": used for state, used in usage.items()})


def _loop(
    bed: Bed,
    asked: Sequence[Subject],
    load: TrainingLoad,
    options: Options,
    results: Results,
    console: Console,
    stack: ExitStack,
) -> None:
    stream, late = transports.open_loop(bed, DEADLINE_MS / 1e3, stack)
    echo = next(subject for subject in asked if subject.key == "echo-ws")
    usage = {state: Usage() for state in options.states}
    for state in options.states:
        console.print(f"control loop for {options.seconds:g} s on model and echo each, {state}", highlight=False)
        under = load if state == "training" else None
        with watched(usage[state], bed.pid):
            results.loops[state] = control_loop(stream, echo, late, options.seconds, under)
        load.stop()
    _note_usage(results, {f"loop, {state}": used for state, used in usage.items()})


def _note_usage(results: Results, usage: dict[str, Usage]) -> None:
    """Add processor time used by others to the facts."""
    if processor.IS_AVAILABLE:
        results.facts |= {f"processor during {name}": str(used) for name, used in usage.items()}


def _describe_source(options: Options) -> str:
    source = options.source
    if source.folder is not None:
        return str(source.folder)
    stream = source.stream
    return (
        f"trained here on a simulated {source.robot}: {stream.n_samples} samples at {stream.rate:g} Hz, "
        f"{stream.n_sinusoids} sinusoids, {stream.motion} range, speed {stream.speed:g}"
    )

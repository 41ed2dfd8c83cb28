"""A benchmark from start to end: options in, results out."""

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
"""What can be measured, by name."""


@dataclass(frozen=True)
class Options:
    """How much is measured.

    runs: of every subject and state; queries: of a run, fewer for what takes long; seconds: of the control loop on the
    model and on the echo each; training: also while a job runs; only: names out of KEYS, all where empty.
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
        """The states that are measured."""
        return ["idle", "training"] if self.training else ["idle"]

    def __post_init__(self) -> None:
        if unknown := [name for name in self.only if name not in KEYS]:
            raise ValueError(f"--only has {unknown[0]!r}, expected names out of {', '.join(KEYS)}")

    def wanted(self, name: str) -> bool:
        """Whether a subject, or the echo that a wanted one is compared with, is measured."""
        return not self.only or name in self.only or name in transports.floors(self.only, LOOP)


def run(options: Options, console: Console) -> Results:
    """Measure everything that the options ask for; raise BenchError where a step fails or an answer is wrong."""
    machine = facts.machine()
    with ExitStack() as stack:
        home = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lipserve-bench-")))
        bed = stack.enter_context(open_bed(home, options.source, console))
        machine["threads of this process"] = stack.enter_context(facts.one_thread())
        manifest = bed.workload.manifest
        said, deviation = facts.model(manifest, _said(options)), facts.deviation(manifest)
        results = Results(machine, said, deviation, options.runs, options.queries)
        load = TrainingLoad(bed, options.source.load)
        stack.callback(load.stop)
        asked = _subjects(bed, options, results, stack)
        _runs(bed, asked, load, options, results, console)
        if options.wanted(LOOP) and options.seconds > 0:
            _loop(bed, asked, load, options, results, console, stack)
        results.rows = {key: results.rows[key] for key in KEYS if key in results.rows}
        results.notes += load.said()
        if options.motions:
            console.print("training on four kinds of motion")
            results.motions = motions.compare(options.source.robot, options.source.fit, options.runs, home, console)
    return results


def _subjects(bed: Bed, options: Options, results: Results, stack: ExitStack) -> list[Subject]:
    """Everything that is asked, each answer checked once; connections stay open as long as `stack`."""
    found = subjects.in_process(bed.workload) + transports.open_all(bed, options.wanted, stack)
    compared, notes, results.unseen = subjects.compared(bed.workload, options.wanted)
    chosen = [subject for subject in [*found, *compared] if options.wanted(subject.key)]
    for subject in chosen:
        subject.check(bed.workload)
    results.notes += [transports.SAID, *notes]
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
    """Who else used the machine; figures taken beside a busy neighbour are to be seen as such."""
    if processor.KNOWN:
        results.facts |= {f"taken during {name}": str(used) for name, used in usage.items()}


def _said(options: Options) -> str:
    source = options.source
    if source.folder is not None:
        return str(source.folder)
    stream = source.stream
    return (
        f"trained here on a simulated {source.robot}: {stream.n_samples} samples at {stream.rate:g} Hz, "
        f"{stream.n_sinusoids} sinusoids, {stream.motion} range, speed {stream.speed:g}"
    )

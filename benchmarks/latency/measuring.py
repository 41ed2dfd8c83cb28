"""Interleaved runs of all subjects, so that a temporary load on the machine affects all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext

import numpy as np

from benchmarks.latency.loop import RATE, run_slice, summarise
from benchmarks.latency.results import LoopPair, Results, Row, State
from benchmarks.latency.subjects import Subject
from benchmarks.load import TrainingLoad
from benchmarks.timing import Nanoseconds, Timing, measure, no_collection

PASSES = 4
"""Passes over all subjects in a run; each measures a part of every subject's queries."""
SLICE_SECONDS = 1.0
"""Length of a slice of the control loop."""
MIN_CALLS = 2
"""Min calls of a slow subject in a pass."""


def add_run(
    results: Results, subjects: Sequence[Subject], state: State, queries: int, load: TrainingLoad | None = None
) -> None:
    """Time `queries` queries of every subject and add the run to the results."""
    times: dict[str, list[Nanoseconds]] = {subject.key: [] for subject in subjects}
    with no_collection():
        for turn in range(PASSES):
            # alternate the order, so that no subject always follows the same one
            for subject in subjects if turn % 2 == 0 else reversed(subjects):
                count = max(MIN_CALLS, round(queries * subject.share / PASSES))
                with _under(load):
                    times[subject.key].append(measure(subject.ask, count, turn * count))
    for subject in subjects:
        row = results.rows.setdefault(subject.key, Row(subject.key, subject.label, subject.floor))
        row.runs.setdefault(state, []).append(Timing.of(np.concatenate(times[subject.key]), subject.queries))


def control_loop(
    asked: Subject, floor: Subject, late: Callable[[], int], seconds: float, load: TrainingLoad | None = None
) -> LoopPair:
    """Run the control loop for `seconds` on each of two subjects in alternating slices.

    `late` returns the service's own count of late answers.
    """
    slices: dict[str, list[Nanoseconds]] = {asked.key: [], floor.key: []}
    left, before = seconds, late()
    with no_collection():
        while left > 0:
            part = min(left, SLICE_SECONDS)
            left -= part
            for subject in (asked, floor):
                with _under(load):
                    slices[subject.key].append(run_slice(subject.ask, max(1, round(part * RATE))))
    return LoopPair(summarise(slices[asked.key]), summarise(slices[floor.key]), late() - before)


@contextmanager
def _under(load: TrainingLoad | None) -> Iterator[None]:
    with nullcontext() if load is None else load.cover_slice():
        yield

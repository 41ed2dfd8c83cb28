"""Subjects timed in this process: the model and the baselines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.latency import baselines
from benchmarks.timing import Ask
from benchmarks.workload import BenchError, Workload
from lipcore.data.samples import Array

BATCH = 1000
"""Queries of a batch."""
CHECKED_QUERIES = 5
"""Queries with answers that are compared with the model's own before the timing."""
TOLERANCE = 1e-6
"""Relative, and in N·m: service and benchmark rebuild the posterior; rounding differs with BLAS threads."""


@dataclass(frozen=True)
class Subject:
    """One measured way to get answers.

    Attributes:
        ask: sends query number k.
        queries: queries answered by one call.
        share: share of a run's queries to send; below 1 for slow subjects.
        floor: key of the echo of its transport.
        answer: returns mean and std of query k, to be checked.
    """

    key: str
    label: str
    ask: Ask
    queries: int = 1
    share: float = 1.0
    floor: str | None = None
    answer: Callable[[int], tuple[Array, Array | None]] | None = None

    def check(self, workload: Workload) -> None:
        """Compare the answers with the model's own; raise BenchError if they differ."""
        if self.answer is None:
            return
        for number in range(CHECKED_QUERIES):
            expected = workload.model.answer(workload.queries[number])
            for name, found, wanted in zip(("tau", "tau_std"), self.answer(number), expected, strict=True):
                if found is None or wanted is None:
                    continue
                if not np.allclose(found, wanted, rtol=TOLERANCE, atol=TOLERANCE):
                    raise BenchError(f"{self.label}: {name} of query {number} is {found}, expected {wanted}")


def in_process(workload: Workload) -> list[Subject]:
    """Return the model itself as subjects: one query with and without standard deviation, and a batch."""
    model, queries = workload.model, list(workload.queries)
    count = len(queries)
    answer = model.answer
    repeated = np.resize(workload.queries, (BATCH, *workload.queries.shape[1:]))
    q, dq, ddq = (np.ascontiguousarray(repeated[:, part]) for part in range(3))

    def batch_row(number: int) -> tuple[Array, Array]:
        found = model.predict(q, dq, ddq)
        return found.tau[number], found.tau_std[number]

    return [
        Subject("mean", "in process, mean only", lambda number: answer(queries[number % count], False)),
        Subject("std", "in process, with std", lambda number: answer(queries[number % count])),
        Subject(
            "batch",
            f"in process, batch of {BATCH}, std",
            lambda number: model.predict(q, dq, ddq),
            queries=BATCH,
            share=0.005,
            answer=batch_row,
        ),
    ]


def make_baselines(workload: Workload, wanted: Callable[[str], bool]) -> tuple[list[Subject], list[str], float | None]:
    """Return the wanted baselines, notes about them, and the model's deviation.

    The deviation is the largest one from the exact posterior at the queries, in standard deviations; None if the exact
    posterior is not a baseline.
    """
    found, notes, largest = [], [], None
    robot, samples = workload.robot, workload.samples
    if wanted("rnea"):
        if robot is None:
            notes.append("Pinocchio RNEA omitted: no simulated robot has the joints of this model.")
        else:
            found.append(Subject("rnea", "Pinocchio RNEA", baselines.rnea(robot, workload.queries)))
    if samples is None:
        if any(map(wanted, ("exact", "gpytorch", "gpytorch-fast"))):
            notes.append("Exact GP and GPyTorch omitted: the training samples of an existing model are not available.")
        return found, notes, largest
    if wanted("exact"):
        posterior = baselines.exact_posterior(workload)
        ask = baselines.exact(posterior, workload.queries)
        found.append(Subject("exact", f"exact GP, {len(posterior.motion)} samples, std", ask, share=0.04))
        largest, note = baselines.deviation(workload, posterior)
        notes.append(note)
    if wanted("gpytorch") or wanted("gpytorch-fast"):
        if baselines.gpytorch_installed():
            model = baselines.GPyTorch(samples, workload.model.noise_std)
            plain, fast = (model.ask(workload.queries, fast_pred_var=each) for each in (False, True))
            found.append(Subject("gpytorch", "GPyTorch exact GPs, std", plain, share=0.005))
            found.append(Subject("gpytorch-fast", "GPyTorch, fast_pred_var", fast, share=0.02))
            notes.append(baselines.GPYTORCH_NOTE)
        else:
            notes.append("GPyTorch omitted: not installed (pip install 'lipserve[bench]').")
    return found, notes, largest

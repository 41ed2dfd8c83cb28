"""A training job in the service that is measured."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from benchmarks import processor
from benchmarks.workload import Bed, BenchError
from lipserve.records.jobs import Job
from lipserve.states import ACTIVE, RUNNING

START_SECONDS = 120.0


class TrainingLoad:
    """A training job that runs while answers are timed; a new job replaces one that has ended.

    Attributes:
        slices: measured slices.
        uncovered: slices of jobs that had ended before.
        seconds: duration of all slices.
        used_s: processor time of the training processes meanwhile; 0 if the system does not report it.
    """

    def __init__(self, bed: Bed, options: Mapping[str, Any]) -> None:
        self.client, self.dataset, self.options, self.pid = bed.client, bed.dataset, dict(options), bed.pid
        self.job: str | None = None
        self.slices = self.uncovered = 0
        self.seconds = self.used_s = 0.0

    @contextmanager
    def cover_slice(self) -> Iterator[None]:
        """Make sure that a job runs, and record whether it still runs at the end."""
        if not self._runs():
            self._start()
        began, before = time.monotonic(), processor.seconds_below(self.pid)
        yield
        self.seconds += time.monotonic() - began
        self.used_s += processor.seconds_below(self.pid) - before
        self.slices += 1
        self.uncovered += not self._runs()

    def stop(self) -> None:
        """Cancel the job and wait for its end."""
        if self.job is not None:
            if self._read_job().state in ACTIVE:
                self.client.cancel(self.job)
                self.client.wait(self.job)
            self.job = None

    def notes(self) -> list[str]:
        """Describe the load; empty if there was none."""
        if not self.slices:
            return []
        used = f"used {self.used_s / self.seconds:.0%} of one core" if processor.IS_AVAILABLE else "ran"
        if self.uncovered:
            ended = f"It ended early in {self.uncovered} of {self.slices} slices, which count nevertheless."
        else:
            ended = f"It ran until the end of each of the {self.slices} slices."
        return [f"Training {used} during the slices that were measured while training. {ended}"]

    def _start(self) -> None:
        self.job = self.client.train("bench-load", [self.dataset], "lip-chain", options=self.options).id
        end = time.monotonic() + START_SECONDS
        while not (self._runs() and self._read_job().progress.stage == "hyperparameters"):
            if self._read_job().state not in ACTIVE or time.monotonic() > end:
                raise BenchError(f"The training job {self.job} did not start; its state is {self._read_job().state}.")
            time.sleep(0.1)

    def _runs(self) -> bool:
        return self.job is not None and self._read_job().state == RUNNING

    def _read_job(self) -> Job:
        assert self.job is not None
        return self.client.job(self.job)

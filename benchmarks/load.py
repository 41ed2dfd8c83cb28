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
    """A training job that goes on while answers are timed; another is queued where one has ended.

    stretches: how many were measured, uncovered: at the end of how many the job had ended; seconds: they took, used: of
    processor time the training processes had meanwhile, 0 where the system does not tell.
    """

    def __init__(self, bed: Bed, options: Mapping[str, Any]) -> None:
        self.client, self.dataset, self.options, self.pid = bed.client, bed.dataset, dict(options), bed.pid
        self.job: str | None = None
        self.stretches = self.uncovered = 0
        self.seconds = self.used = 0.0

    @contextmanager
    def stretch(self) -> Iterator[None]:
        """Make sure that a job runs, and note whether the same one still runs at the end."""
        if not self._runs():
            self._start()
        began, before = time.monotonic(), processor.seconds_below(self.pid)
        yield
        self.seconds += time.monotonic() - began
        self.used += processor.seconds_below(self.pid) - before
        self.stretches += 1
        self.uncovered += not self._runs()

    def stop(self) -> None:
        """Cancel the job and wait for its end."""
        if self.job is not None:
            if self._seen().state in ACTIVE:
                self.client.cancel(self.job)
                self.client.wait(self.job)
            self.job = None

    def said(self) -> list[str]:
        """What a reader has to know of the load; nothing where there was none."""
        if not self.stretches:
            return []
        known = processor.KNOWN
        share = f"training had {self.used / self.seconds:.0%} of one core" if known else "a training job was there"
        if self.uncovered:
            ended = f"the job had ended at the end of {self.uncovered} of {self.stretches}, which count all the same"
        else:
            ended = f"a job still ran at the end of each of {self.stretches}"
        return [f"{share} during the stretches measured under it; {ended}"]

    def _start(self) -> None:
        self.job = self.client.train("bench-load", [self.dataset], "lip-chain", options=self.options).id
        end = time.monotonic() + START_SECONDS
        while not (self._runs() and self._seen().progress.stage == "hyperparameters"):
            if self._seen().state not in ACTIVE or time.monotonic() > end:
                raise BenchError(f"the training job {self.job} did not start: it has {self._seen().state}")
            time.sleep(0.1)

    def _runs(self) -> bool:
        return self.job is not None and self._seen().state == RUNNING

    def _seen(self) -> Job:
        assert self.job is not None
        return self.client.job(self.job)

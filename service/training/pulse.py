"""Heartbeat and progress of a training process, and the remaining time of its fit."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from contextvars import copy_context
from dataclasses import dataclass
from math import inf
from types import TracebackType
from typing import Any, Self

from lipcore.estimators.hyperparameters import FitProgress
from service.runtime.progress import Progress
from service.storage.database import Database, JobRow, now

SEARCH = "hyperparameters"


@dataclass(frozen=True)
class PaceOptions:
    """Durations of the parts of a job, relative to each other."""

    min_fraction: float = 0.05
    """Share of several fits after which their pace can be estimated."""
    min_iterations: int = 3
    """Iterations of a search after which its pace can be estimated."""
    posterior_iterations: float = 1.5
    """Duration of conditioning, compressing and saving in iterations of the search on equally many samples. Both grow
    with the cube of their samples: measured 0.9 for two joints and 1.9 for seven.
    """
    fit_rows: int = 200_000
    """A pass over so many rows takes about as long as a fit; for the displayed fraction."""
    last_fit_rows: int = 20_000
    """A pass over so many rows takes about as long as the last fit, which does not search."""


PACE = PaceOptions()


class RemainingTime:
    """Estimate of a fit's remaining time, extrapolated from the pace of its search.

    `searched` and `conditioned` are the samples of the search and of the posterior. The search is assumed to need all
    of its iterations; it often converges earlier.
    """

    def __init__(self, searched: int, conditioned: int) -> None:
        self._after_search = max(1.0, PACE.posterior_iterations * (conditioned / searched) ** 3)
        self._first: tuple[float, int] | None = None
        self._pace: float | None = None
        self._ends: float | None = None

    def step(self, at: FitProgress, clock: float) -> None:
        """Add a step of the fit; `clock` is monotonic time, s."""
        if at.estimator is not None:  # one of several fits: estimated from the finished share of all
            if at.fraction >= PACE.min_fraction:
                self._ends = clock + at.elapsed * (1 - at.fraction) / at.fraction
            return
        if at.stage == SEARCH:
            if (
                self._first is None or at.iteration <= self._first[1]
            ):  # the first search, or the next one: an arm has its own
                self._first = (clock, at.iteration)
            elif at.iteration >= PACE.min_iterations:
                began, before = self._first
                self._pace = (clock - began) / (at.iteration - before)
        if self._pace is not None:
            left = at.max_iterations - at.iteration if at.stage == SEARCH else 0
            self._ends = clock + self._pace * (left + self._after_search)

    def seconds(self, clock: float) -> float | None:
        """Return the remaining seconds at a monotonic time; None if unknown, or if the estimate was too low."""
        if self._ends is None or clock >= self._ends:
            return None
        return self._ends - clock


logger = logging.getLogger(__name__)

BEAT_S = 0.5
"""Interval between two heartbeats, s."""
STATISTICS = "statistics"
"""Stage of the pass over all rows."""
LAST_FIT = "all_rows"
"""Stage of the fit that also learns the held-out rows."""


class SupersededError(RuntimeError):
    """Another attempt has the job."""


class Heartbeat:
    """Writes heartbeats and progress to a job's row while its block runs and makes progress.

    The fit reports to it and reads from it without waiting for the database. A process that hangs sends no more
    heartbeats and is killed by its watcher, see `lifecycle`.

    `own` reads the job's row in a session and raises SupersededError if another attempt has the job. `model` is the
    job's model: writers of other models need not wait for a heartbeat. `quiet_s` is the maximum time without progress,
    s.
    """

    def __init__(self, database: Database, own: Callable[[Any], JobRow], model: str, quiet_s: float = inf) -> None:
        self.database, self.own, self.model = database, own, model
        self.remaining: RemainingTime | None = None
        self._began = time.monotonic()
        self._fit_begins, self._fit_ends, self._pass_ends = 0.0, 1.0, 1.0  # fractions
        self._passes_later, self._pass_began = 0.0, (0.0, 0.0)
        self._ends: float | None = None
        self._latest: dict[str, Any] = {"stage": "loading"}
        self._stop, self._superseded = False, False
        pids = (os.getpid(),)
        self._progress, self._hangs = Progress(lambda: pids, quiet_s, inf), False
        self._wake, self._ended = threading.Event(), False
        # in the context of the job, so that log lines contain its id
        self._thread = threading.Thread(target=copy_context().run, args=(self._beat,), daemon=True, name="pulse")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    @property
    def elapsed(self) -> float:
        """Seconds since the attempt began."""
        return time.monotonic() - self._began

    def progress(self, at: FitProgress) -> None:
        """Record the fit's progress; the next heartbeat writes it."""
        self._progress.step()
        if self.remaining is not None:
            self.remaining.step(at, time.monotonic())
        changed = at.stage != self._latest["stage"]
        self._latest = {
            "stage": at.stage,
            "estimator": at.estimator,
            "iteration": at.iteration,
            "max_iterations": at.max_iterations,
            "objective": at.objective,
            "fraction": self._during_fit(at),
        }
        if changed:
            self._wake.set()

    def last_fit(self, at: FitProgress) -> None:
        """Record the progress of the last fit; iterations and objective stay those of the search before it."""
        self._progress.step()
        self._latest = {**self._latest, "fraction": self._during_fit(at)}

    def plan(self, fit: int, rows: int, later: int = 0) -> None:
        """Divide the remaining fraction among a fit that begins, a pass over `rows` rows, and the rest.

        `fit` and `later` are numbers of rows: a pass over them takes as long. `later` is everything after the pass.
        """
        begins, total = self._latest.get("fraction", 0.0), fit + rows + later
        self._fit_begins = begins
        self._fit_ends = begins + (1.0 - begins) * fit / total
        self._pass_ends = begins + (1.0 - begins) * (fit + rows) / total
        self._passes_later = later / rows if rows else 0.0
        self.remaining = self._ends = None

    def share(self, done: float) -> None:
        """Record the finished share of the pass; the remaining time is estimated from its pace."""
        self._progress.step()
        clock = time.monotonic()
        if self._latest["stage"] != STATISTICS or self._pass_began[1] == 0.0:  # the start of the workers does not count
            self._pass_began = clock, done
        began, before = self._pass_began
        if done > before:
            self._ends = clock + (clock - began) * (1.0 - done + self._passes_later) / (done - before)
        fraction = self._fit_ends + (min(self._pass_ends, 0.98) - self._fit_ends) * done
        self._latest = {
            **self._latest,
            "stage": STATISTICS,
            "estimator": None,
            "fraction": max(fraction, self._latest["fraction"]),
        }

    def stage(self, name: str) -> None:
        """Record the stage that begins."""
        self._progress.step()
        self._latest = {**self._latest, "stage": name, "estimator": None}
        self._wake.set()

    def cancelled(self) -> bool:
        """Return whether to stop; raise SupersededError if another attempt has the job."""
        self._progress.step()  # the caller is working, even if it waits for the processes that share the work
        if self._superseded:
            raise SupersededError
        return self._stop

    def _during_fit(self, at: FitProgress) -> float:
        return self._fit_begins + (self._fit_ends - self._fit_begins) * at.fraction

    def as_json(self) -> dict[str, Any]:
        """Return the progress as it is written now."""
        left = None if self.remaining is None else self.remaining.seconds(time.monotonic())
        if self._ends is not None:
            left = max(0.0, self._ends - time.monotonic())
        remaining = None if left is None else round(left, 1)
        return {**self._latest, "elapsed_s": round(self.elapsed, 3), "remaining_s": remaining}

    def end(self) -> None:
        """Stop the heartbeats, so that later changes of the row persist."""
        self._ended = True
        self._wake.set()
        self._thread.join()

    def _beat(self) -> None:
        while not self._ended and not self._superseded:
            try:
                self._exchange()
            except SupersededError:
                self._superseded = True
            except Exception:  # the database may be locked or the disk full for a while: training continues
                logger.exception("could not store the progress")
            self._wake.wait(BEAT_S)
            self._wake.clear()

    def _exchange(self) -> None:
        with self.database.transaction(self.model) as session:
            row = self.own(session)
            if self._gets_on():
                row.progress, row.heartbeat_at = self.as_json(), now()
            self._stop = row.cancel_requested

    def _gets_on(self) -> bool:
        reason = self._progress.check()
        if reason is not None and not self._hangs:
            logger.error("no more heartbeats are sent: %s", reason)
        self._hangs = reason is not None
        return not self._hangs

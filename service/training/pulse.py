"""A training process's talk with the database, in a thread of its own: signs of life and progress out, the wish to
cancel in. However long a step of the fit takes, the service sees that the process lives."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from contextvars import copy_context
from types import TracebackType
from typing import Any, Self

from lipcore.fitting import FitProgress
from service.database import Database, JobRow, now
from service.training.remaining import Remaining

logger = logging.getLogger(__name__)

BEAT_S = 0.5
"""Seconds between two signs of life."""


class SupersededError(RuntimeError):
    """The job is no longer this attempt's."""


class Pulse:
    """Beats while its block runs. The fit asks and tells it without waiting for the database.

    own: reads the job's row in a session; raises SupersededError where it is not this attempt's any more.
    """

    def __init__(self, database: Database, own: Callable[[Any], JobRow]) -> None:
        self.database, self.own = database, own
        self.remaining: Remaining | None = None
        self._began = time.monotonic()
        self._latest: dict[str, Any] = {"stage": "loading"}
        self._stop, self._superseded = False, False
        self._wake, self._ended = threading.Event(), False
        # in the context of the job, which its log lines name
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
        """Take the fit's progress; it is written with the next beat."""
        if self.remaining is not None:
            self.remaining.step(at, time.monotonic())
        changed = at.stage != self._latest["stage"]
        self._latest = {
            "stage": at.stage,
            "iteration": at.iteration,
            "max_iterations": at.max_iterations,
            "objective": at.objective,
            "fraction": at.fraction,
        }
        if changed:
            self._wake.set()

    def stage(self, name: str) -> None:
        """Say what is done now."""
        self._latest = {**self._latest, "stage": name}
        self._wake.set()

    def cancelled(self) -> bool:
        """Whether to stop; raise SupersededError where the job was given to another attempt."""
        if self._superseded:
            raise SupersededError
        return self._stop

    def shown(self) -> dict[str, Any]:
        """The progress as it is written now."""
        left = None if self.remaining is None else self.remaining.seconds(time.monotonic())
        remaining = None if left is None else round(left, 1)
        return {**self._latest, "elapsed_s": round(self.elapsed, 3), "remaining_s": remaining}

    def end(self) -> None:
        """Stop beating: what is written to the row from then on stays."""
        self._ended = True
        self._wake.set()
        self._thread.join()

    def _beat(self) -> None:
        while not self._ended and not self._superseded:
            try:
                self._exchange()
            except SupersededError:
                self._superseded = True
            except Exception:  # the database may be locked or the disk full for a while: training goes on
                logger.exception("the progress could not be written")
            self._wake.wait(BEAT_S)
            self._wake.clear()

    def _exchange(self) -> None:
        with self.database.transaction() as session:
            row = self.own(session)
            row.progress, row.heartbeat_at = self.shown(), now()
            self._stop = row.cancel_requested

"""States of a job from the queue to its end; every change adds an entry to its row.

The heartbeats of a process show whether it still runs its job. Once it does not, the job waits again or has ended, and
its unpublished files are removed.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.contract.states import ACTIVE, CANCELLED, FAILED, QUEUED, RUNNING, SUCCEEDED, JobState
from service.foundation.settings import Settings
from service.runtime.progress import HEARTBEAT_S
from service.storage.database import Database, JobRow, VersionRow, now
from service.storage.files import Files, new_id
from service.training import texts

MAX_ENTRIES = 100
"""Maximum entries of a job. A waiting job may see any number of service restarts."""


logger = logging.getLogger(__name__)


def enter(row: JobRow, state: JobState, message: str) -> None:
    """Set a job's state, add an entry with time and reason, and log it: three lines for a job that runs undisturbed.

    An end is stamped; a waiting job has no progress.
    """
    logger.info("%s of %s: %s", row.id, row.model, message)
    at = now()
    entries = [*(row.history or []), {"at": at, "state": state, "message": message}]
    # keep the first entry, which says how the job was queued, and the newest others
    row.history = entries if len(entries) <= MAX_ENTRIES else [entries[0], *entries[1 - MAX_ENTRIES :]]
    row.state = state
    if state == QUEUED:
        row.progress = {"stage": "waiting"}
        row.owner = None  # any service may run it
    elif state not in ACTIVE:
        row.finished_at = at


def row_of(session: Session, job: str) -> JobRow | None:
    """Return the row of a job, None if there is none."""
    row: JobRow | None = session.scalar(select(JobRow).where(JobRow.id == job))
    return row


def requeue(row: JobRow, why: str) -> None:
    """Let a job wait again after an orderly stop of its process; that start does not count as an attempt."""
    if row.cancel_requested:
        enter(row, CANCELLED, f"cancelled: {why}")
    else:
        row.attempts -= 1
        enter(row, QUEUED, f"{why}: queued again")


Why = Literal["returned", "ended", "cancelled", "silent", "too_long", "not_started", "lingering", "refused"]


@dataclass(frozen=True)
class JobLimits:
    """Limits on the attempts of a job and on the times of its process."""

    attempts: int = 3
    """Starts before an interruption fails the job."""
    start_s: float = 120.0
    """Time until the process must be ready, s."""
    heartbeat_s: float = HEARTBEAT_S
    """Maximum time without progress, s."""
    cancel_s: float = 1.0
    """Time to obey a cancellation, s."""
    linger_s: float = 10.0
    """Time to clean up after the end of the job, s."""
    pause_s: float = 1.0
    """Delay before a job is started again if its process could not start, s; doubled each time."""


LIMITS = JobLimits()


@dataclass(frozen=True)
class JobStatus:
    """State of a job as its row contains it."""

    state: str
    heartbeat_at: str | None
    cancel_requested: bool
    attempts: int = 0
    """Number of starts."""
    ours: bool = True
    """Whether this service still owns the job."""


@dataclass(frozen=True)
class JobEnd:
    """The end of an attempt at a job: its process no longer runs it."""

    job: str
    why: Why
    message: str
    """The reason in words."""
    attempt: int | None = None
    """Number of the attempt; None means the last."""


@dataclass(eq=False)
class WatchedJob:
    """A job that a process runs, and what its watcher has seen of it.

    Times are monotonic, s, so that clock changes or a suspended machine do not count as silence.
    """

    job: str
    slot: Any
    """The slot of the process, as the kind of queue needs it."""
    future: Any
    """Completes with the process's call."""
    since: float
    """When the process received the job."""
    away: bool = False
    """Whether the process belongs to a worker elsewhere, for which the job may have to wait."""
    ran: float | None = None
    """When it was first seen running."""
    stopped: float | None = None
    """When its cancellation was first seen."""
    done: float | None = None
    """When its end was first seen."""
    heartbeat: str | None = None
    """The last heartbeat seen."""
    beat_at: float = 0.0
    """When that heartbeat was first seen."""

    def update(self, status: JobStatus, clock: float) -> None:
        """Record the state in the row."""
        if status.state == RUNNING and self.ran is None:
            self.ran = self.beat_at = clock
        if status.heartbeat_at != self.heartbeat:
            self.heartbeat, self.beat_at = status.heartbeat_at, clock
        if status.cancel_requested:
            self.stop(clock)
        if (status.state not in ACTIVE or not status.ours) and self.done is None:
            self.done = clock

    def stop(self, clock: float) -> None:
        """Record a cancellation; it counts once the process has started."""
        if self.ran is not None and self.stopped is None:
            self.stopped = clock

    def judge(self, settings: Settings, clock: float) -> JobEnd | None:
        """Return why the process must be killed now, None if it need not be."""
        if self.away:
            if self.done is not None:
                return JobEnd(self.job, "returned", texts.ENDED_ELSEWHERE)
            clock -= 0.5  # leave time for the worker's host, which applies the same rules
        if self.done is not None:
            late = clock - self.done >= LIMITS.linger_s
            return JobEnd(self.job, "lingering", texts.LINGERS) if late else None
        if self.stopped is not None:
            if clock - self.stopped < LIMITS.cancel_s:
                return None
            return JobEnd(self.job, "cancelled", texts.describe_unstoppable(LIMITS.cancel_s))
        if self.ran is None:
            if self.away or clock - self.since < LIMITS.start_s:
                return None
            return JobEnd(self.job, "not_started", texts.describe_not_ready(LIMITS.start_s))
        if clock - self.beat_at >= LIMITS.heartbeat_s:
            return JobEnd(self.job, "silent", texts.describe_no_progress(LIMITS.heartbeat_s))
        if clock - self.ran >= settings.max_job_s:
            return JobEnd(self.job, "too_long", texts.describe_too_long(settings.max_job_s))
        return None


def new_folder(job: str) -> str:
    """Return a new folder name for a version that `job` makes; the name identifies the job."""
    return new_id(f"mv_{_folder_mark(job)}")


def remove_leftovers(database: Database, files: Files, job: str) -> int:
    """Delete the folders of a job that does not run and that no version uses; return how many."""
    with database.session() as session:
        state = session.scalar(select(JobRow.state).where(JobRow.id == job))
    try:
        names = files.versions_marked(_folder_mark(job), ended=state not in ACTIVE)
        with database.session() as session:
            known = set(session.scalars(select(VersionRow.folder).where(VersionRow.folder.in_(names))))
        left = [name for name in names if name not in known]
        for name in left:
            files.delete_version(name)
    except OSError as error:
        logger.warning("unpublished files of %s could not be deleted; the next sweep will: %s", job, error)
        return 0
    return len(left)


def _folder_mark(job: str) -> str:
    return job.removeprefix("job_")


@dataclass(frozen=True)
class JobOutcome:
    """The result of settling a job."""

    again: bool = False
    """Whether the job is queued again, to start after `pause_s`."""
    pause_s: float = 0.0
    made: tuple[str, int] | None = None
    """Model and version that the job created; None if it created none."""
    problem: str | None = None
    """Why no process could be started for the job; None if one was started."""


class Settler:
    """Settles ended jobs; to be used by one thread. `mine` returns whether this service settles jobs of an owner."""

    def __init__(
        self,
        database: Database,
        files: Files,
        mine: Callable[[str | None], bool] = lambda _: True,
    ) -> None:
        self.database, self.files, self.mine = database, files, mine
        self._starts: dict[str, int] = {}

    def settle(self, end: JobEnd) -> JobOutcome:
        """Write the outcome of a job. Database errors are raised; the call can be repeated."""
        remove_leftovers(self.database, self.files, end.job)
        with self.database.transaction() as session:
            row = row_of(session, end.job)
            outcome = JobOutcome() if row is None else self._decide(row, end)
        if outcome.problem is None:
            self._starts.pop(end.job, None)
        else:
            self._starts[end.job] = self._starts.get(end.job, 0) + 1
        return outcome

    def _decide(self, row: JobRow, end: JobEnd) -> JobOutcome:
        if row.state == SUCCEEDED and row.version is not None:
            return JobOutcome(made=(row.model, row.version))
        if row.state not in ACTIVE or not self.mine(row.owner):
            return JobOutcome()
        if row.state == RUNNING and (end.why == "refused" or end.attempt not in (None, row.attempts)):
            return JobOutcome()  # another attempt runs
        if end.why == "cancelled" or row.cancel_requested:
            enter(row, CANCELLED, f"cancelled: {end.message}")
            return JobOutcome()
        logger.error("%s: %s", row.id, end.message)
        if end.why == "too_long":
            fail(row, "too_long", end.message)
            return JobOutcome()
        if row.state == RUNNING:
            return JobOutcome(again=queue_again(row, end.message, LIMITS.attempts))
        if end.why == "returned":  # it was queued again while it ran
            return JobOutcome(again=True)
        starts = self._starts.get(end.job, 0)
        if starts + 1 >= LIMITS.attempts:
            message = f"{end.message}: {starts + 1} starts have failed"
            fail(row, "interrupted", message)
            return JobOutcome()
        pause = min(LIMITS.pause_s * 2**starts, 30.0)
        enter(row, QUEUED, f"{end.message}: queued again")
        return JobOutcome(again=True, pause_s=pause, problem=end.message)


def queue_again(row: JobRow, message: str, most_attempts: int) -> bool:
    """Queue an interrupted job again and return True, or end it and return False.

    It ends if it was cancelled or has no attempts left.
    """
    if row.cancel_requested:
        enter(row, CANCELLED, f"cancelled: {message}")
    elif row.attempts >= most_attempts:
        fail(row, "interrupted", f"{message}: interrupted {row.attempts} times")
    else:
        enter(row, QUEUED, f"{message}: queued again")
        return True
    return False


def fail(row: JobRow, code: str, message: str) -> None:
    """End a job as failed."""
    enter(row, FAILED, message)
    row.error = {"code": code, "message": message}

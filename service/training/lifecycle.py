"""What becomes of a job, from when it is queued to its end: every change has an entry in its row.

A process that runs a job is judged by its signs of life; once it no longer runs it, the job waits again or has ended,
and files that it began to write and did not publish are removed.
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

MOST_ENTRIES = 100
"""Entries that a job keeps: a service may be started and stopped any number of times while one waits."""


def enter(row: JobRow, state: JobState, message: str) -> None:
    """Set a job's state and note when and why. An end is stamped; who waits again has made no progress."""
    at = now()
    entries = [*(row.history or []), {"at": at, "state": state, "message": message}]
    # the first entry says who queued it; of the others the newest count
    row.history = entries if len(entries) <= MOST_ENTRIES else [entries[0], *entries[1 - MOST_ENTRIES :]]
    row.state = state
    if state == QUEUED:
        row.progress = {"stage": "waiting"}
        row.owner = None  # any service may have it run
    elif state not in ACTIVE:
        row.finished_at = at


def row_of(session: Session, job: str) -> JobRow | None:
    """The row of a job, None where there is none."""
    row: JobRow | None = session.scalar(select(JobRow).where(JobRow.id == job))
    return row


def hand_back(row: JobRow, why: str) -> None:
    """Let a job wait again whose process was stopped in order: such a start is no failed attempt."""
    if row.cancel_requested:
        enter(row, CANCELLED, f"cancelled: {why}")
    else:
        row.attempts -= 1
        enter(row, QUEUED, f"{why}: queued again")


Why = Literal["returned", "ended", "cancelled", "silent", "too_long", "not_started", "lingering", "refused"]


@dataclass(frozen=True)
class JobLimits:
    """How often a job is started, and how long its process may take.

    attempts: starts before an interruption fails the job. start_s: until the process is ready. heartbeat_s: without
    progress. cancel_s: until it obeys a cancel. linger_s: to tidy up after the end of its job. pause_s: before a job is
    handed out again whose process could not be started; each time twice as long.
    """

    attempts: int = 3
    start_s: float = 120.0
    heartbeat_s: float = HEARTBEAT_S
    cancel_s: float = 1.0
    linger_s: float = 10.0
    pause_s: float = 1.0


LIMITS = JobLimits()


@dataclass(frozen=True)
class Facts:
    """What a job's row says of it. attempts: how often it was started; ours: whether it still is this service's."""

    state: str
    heartbeat_at: str | None
    cancel_requested: bool
    attempts: int = 0
    ours: bool = True


@dataclass(frozen=True)
class Ended:
    """A job whose process no longer runs it. message: why, in words; attempt: which one it was, None: the last one."""

    job: str
    why: Why
    message: str
    attempt: int | None = None


@dataclass(eq=False)
class Hand:
    """A job in the hands of a process. Times are monotonic, s: steps of the wall clock, or a machine that slept, are
    no silence.

    slot: the place of the process, and future: its end, as the kind of queue has them; away: it is the process of a
    worker elsewhere, for which the job may have to wait; since: when it was handed over; ran, stopped, done: when it
    was first seen to run, to be cancelled and to have ended; heartbeat: the last one seen, and beat_at: when.
    """

    job: str
    slot: Any
    future: Any
    since: float
    away: bool = False
    ran: float | None = None
    stopped: float | None = None
    done: float | None = None
    heartbeat: str | None = None
    beat_at: float = 0.0

    def see(self, facts: Facts, clock: float) -> None:
        """Take note of what the row says."""
        if facts.state == RUNNING and self.ran is None:
            self.ran = self.beat_at = clock
        if facts.heartbeat_at != self.heartbeat:
            self.heartbeat, self.beat_at = facts.heartbeat_at, clock
        if facts.cancel_requested:
            self.stop(clock)
        if (facts.state not in ACTIVE or not facts.ours) and self.done is None:
            self.done = clock

    def stop(self, clock: float) -> None:
        """Take note of the wish to cancel: it counts once the process has begun."""
        if self.ran is not None and self.stopped is None:
            self.stopped = clock

    def judge(self, settings: Settings, clock: float) -> Ended | None:
        """Why the process has to be ended now, None while it need not be."""
        if self.away:
            if self.done is not None:
                return Ended(self.job, "returned", "it has ended, or is another service's")
            clock -= 0.5  # the host of a process elsewhere judges it, too
        if self.done is not None:
            late = clock - self.done >= LIMITS.linger_s
            return Ended(self.job, "lingering", "the process did not go on after its end") if late else None
        if self.stopped is not None:
            if clock - self.stopped < LIMITS.cancel_s:
                return None
            message = f"the training process did not stop within {LIMITS.cancel_s:g} s and was ended"
            return Ended(self.job, "cancelled", message)
        if self.ran is None:
            if self.away or clock - self.since < LIMITS.start_s:
                return None
            return Ended(self.job, "not_started", f"no training process was ready within {LIMITS.start_s:g} s")
        if clock - self.beat_at >= LIMITS.heartbeat_s:
            message = f"the training process gave no sign of life for {LIMITS.heartbeat_s:g} s and was ended"
            return Ended(self.job, "silent", message)
        if clock - self.ran >= settings.max_job_s:
            return Ended(self.job, "too_long", f"it ran for {settings.max_job_s:g} s, the longest that a job may")
        return None


logger = logging.getLogger(__name__)


def new_folder(job: str) -> str:
    """A fresh name for a folder of a version that `job` makes, from which the job can be told."""
    return new_id(f"mv_{_folder_mark(job)}")


def remove_leftovers(database: Database, files: Files, job: str) -> int:
    """Delete what a job that runs nowhere has written and no version names; return how many folders."""
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
        logger.warning("files that %s did not publish are left until they are swept: %s", job, error)
        return 0
    return len(left)


def _folder_mark(job: str) -> str:
    return job.removeprefix("job_")


@dataclass(frozen=True)
class Settled:
    """What has become of a job. again: it waits for a process, to be handed out after `pause_s`; made: the model and
    the version that it has made; problem: why no process could be started for it."""

    again: bool = False
    pause_s: float = 0.0
    made: tuple[str, int] | None = None
    problem: str | None = None


class Settler:
    """Settles one job after the other. To be used by one thread. mine: whether a job with an owner is to be settled."""

    def __init__(
        self,
        database: Database,
        files: Files,
        mine: Callable[[str | None], bool] = lambda _: True,
    ) -> None:
        self.database, self.files, self.mine = database, files, mine
        self._starts: dict[str, int] = {}

    def settle(self, ended: Ended) -> Settled:
        """Write what becomes of a job; raises what the database raises, and may be called again then."""
        remove_leftovers(self.database, self.files, ended.job)
        with self.database.transaction() as session:
            row = row_of(session, ended.job)
            settled = Settled() if row is None else self._decide(row, ended)
        if settled.problem is None:
            self._starts.pop(ended.job, None)
        else:
            self._starts[ended.job] = self._starts.get(ended.job, 0) + 1
        return settled

    def _decide(self, row: JobRow, ended: Ended) -> Settled:
        if row.state == SUCCEEDED and row.version is not None:
            return Settled(made=(row.model, row.version))
        if row.state not in ACTIVE or not self.mine(row.owner):
            return Settled()
        if row.state == RUNNING and (ended.why == "refused" or ended.attempt not in (None, row.attempts)):
            return Settled()  # another attempt runs
        if ended.why == "cancelled" or row.cancel_requested:
            enter(row, CANCELLED, f"cancelled: {ended.message}")
            return Settled()
        logger.error("%s: %s", row.id, ended.message)
        if ended.why == "too_long":
            fail(row, "too_long", ended.message)
            return Settled()
        if row.state == RUNNING:
            return Settled(again=queue_again(row, ended.message, LIMITS.attempts))
        if ended.why == "returned":  # it was queued again while it ran
            return Settled(again=True)
        starts = self._starts.get(ended.job, 0)
        if starts + 1 >= LIMITS.attempts:
            message = f"{ended.message}: no training process could be started for it, {starts + 1} times"
            fail(row, "interrupted", message)
            return Settled()
        pause = min(LIMITS.pause_s * 2**starts, 30.0)
        enter(row, QUEUED, f"{ended.message}: it waits for another one")
        return Settled(again=True, pause_s=pause, problem=ended.message)


def queue_again(row: JobRow, message: str, most_attempts: int) -> bool:
    """Let an interrupted job wait again, or end it where that was wished or tried too often; return if it waits."""
    if row.cancel_requested:
        enter(row, CANCELLED, f"cancelled: {message}")
    elif row.attempts >= most_attempts:
        fail(row, "interrupted", f"{message}: the training process ended before its job, {row.attempts} times")
    else:
        enter(row, QUEUED, f"{message}: queued again")
        return True
    return False


def fail(row: JobRow, code: str, message: str) -> None:
    """End a job that was not to be done."""
    enter(row, FAILED, message)
    row.error = {"code": code, "message": message}

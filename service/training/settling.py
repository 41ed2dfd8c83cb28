"""What becomes of a job whose process no longer runs it: it waits again, or has ended. All is in its row."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

from sqlalchemy import select

from service.foundation.settings import Settings
from service.foundation.states import ACTIVE, CANCELLED, FAILED, QUEUED, RUNNING, SUCCEEDED
from service.storage.database import Database, JobRow
from service.storage.files import Files
from service.training import history, leftovers
from service.training.watch import Ended

logger = logging.getLogger(__name__)

FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 30.0
"""Wait before a job is handed out again whose process could not be started: each time twice as long."""


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
        settings: Settings,
        database: Database,
        files: Files,
        mine: Callable[[str | None], bool] = lambda _: True,
    ) -> None:
        self.settings, self.database, self.files, self.mine = settings, database, files, mine
        self._starts: dict[str, int] = {}

    def settle(self, ended: Ended) -> Settled:
        """Write what becomes of a job; raises what the database raises, and may be called again then."""
        leftovers.remove(self.database, self.files, ended.job)
        with self.database.transaction() as session:
            row = session.scalar(select(JobRow).where(JobRow.id == ended.job))
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
            history.enter(row, CANCELLED, f"cancelled: {ended.message}")
            return Settled()
        logger.error("job %s: %s", row.id, ended.message)
        if ended.why == "too_long":
            fail(row, "too_long", ended.message)
            return Settled()
        if row.state == RUNNING:
            return Settled(again=queue_again(row, ended.message, self.settings.max_job_attempts))
        if ended.why == "returned":  # it was queued again while it ran
            return Settled(again=True)
        starts = self._starts.get(ended.job, 0)
        if starts + 1 >= self.settings.max_job_attempts:
            message = f"{ended.message}: no training process could be started for it, {starts + 1} times"
            fail(row, "interrupted", message)
            return Settled()
        pause = min(FIRST_PAUSE_S * 2**starts, LONGEST_PAUSE_S)
        history.enter(row, QUEUED, f"{ended.message}: it waits for another one")
        return Settled(again=True, pause_s=pause, problem=ended.message)


def queue_again(row: JobRow, message: str, most_attempts: int) -> bool:
    """Let an interrupted job wait again, or end it where that was wished or tried too often; return if it waits."""
    if row.cancel_requested:
        history.enter(row, CANCELLED, f"cancelled: {message}")
    elif row.attempts >= most_attempts:
        fail(row, "interrupted", f"{message}: the training process ended before its job, {row.attempts} times")
    else:
        history.enter(row, QUEUED, f"{message}: queued again")
        return True
    return False


def fail(row: JobRow, code: str, message: str) -> None:
    """End a job that was not to be done."""
    history.enter(row, FAILED, message)
    row.error = {"code": code, "message": message}

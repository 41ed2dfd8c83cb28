"""The jobs that have ended: their durations for metrics, and the deletion of old ones."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime

from sqlalchemy import delete, exists, func, select
from sqlalchemy.orm import Session

from service.contract.states import CANCELLED, FAILED, SUCCEEDED
from service.foundation.settings import Settings
from service.storage.audit import oldest_kept
from service.storage.database import Database, DeletedJobsRow, JobRow, VersionRow
from service.telemetry.counters import Tally
from service.telemetry.meters import Durations

OUTCOMES = (SUCCEEDED, FAILED, CANCELLED)
BOUNDS_S = (1.0, 3.0, 10.0, 30.0, 60.0, 180.0, 600.0, 1800.0, 3600.0, 10_800.0, 36_000.0)
"""Upper bounds of the durations of jobs, s."""
CHUNK_JOBS = 200
"""Jobs deleted in one transaction."""


def count_jobs(session: Session) -> dict[str, int]:
    """Return the number of ended jobs by outcome, with those that were deleted."""
    states = select(JobRow.state, func.count()).where(JobRow.state.in_(OUTCOMES)).group_by(JobRow.state)
    found = dict.fromkeys(OUTCOMES, 0) | dict(session.execute(states).all())
    for row in session.scalars(select(DeletedJobsRow)):
        found[row.outcome] += row.jobs
    return found


def read_durations(session: Session) -> dict[str, Durations]:
    """Return the durations of ended jobs by outcome, with those that were deleted."""
    found = {outcome: Durations(BOUNDS_S) for outcome in OUTCOMES}
    for row in session.scalars(select(DeletedJobsRow)):
        found[row.outcome] = _durations_of(row)
    ended = select(JobRow.state, JobRow.started_at, JobRow.finished_at).where(JobRow.state.in_(OUTCOMES))
    for outcome, started, finished in session.execute(ended):
        _add_duration(found[outcome], started, finished)
    return found


def clean(database: Database, settings: Settings) -> int:
    """Delete the jobs that ended before the oldest line of the audit log that is kept; return their number.

    Jobs that made a version that still exists stay. Deleted jobs remain in the metrics.
    """
    gone = 0
    made = exists().where(VersionRow.job == JobRow.id)
    old = (JobRow.state.in_(OUTCOMES), JobRow.finished_at < oldest_kept(settings), ~made)
    query = select(JobRow).where(*old).order_by(JobRow.seq).limit(CHUNK_JOBS)
    while True:
        with database.session() as session:  # a transaction would block other writers
            if session.scalar(query.with_only_columns(JobRow.seq)) is None:
                return gone
        with database.transaction() as session:
            rows = list(session.scalars(query))
            _note_deletion(session, rows)
            session.execute(delete(JobRow).where(JobRow.seq.in_([row.seq for row in rows])))
        gone += len(rows)


def _note_deletion(session: Session, rows: Iterable[JobRow]) -> None:
    for row in rows:
        noted = session.get(DeletedJobsRow, row.state)
        if noted is None:
            noted = DeletedJobsRow(outcome=row.state, jobs=0, seconds=0.0, durations=[0] * (len(BOUNDS_S) + 1))
            session.add(noted)
        durations = _durations_of(noted)
        _add_duration(durations, row.started_at, row.finished_at)
        noted.jobs, noted.seconds, noted.durations = noted.jobs + 1, durations.total, list(durations.counts)


def _durations_of(noted: DeletedJobsRow) -> Durations:
    return Durations(BOUNDS_S, Tally(list(noted.durations), [noted.seconds]))


def _add_duration(durations: Durations, started: str | None, finished: str | None) -> None:
    """Add the duration of a job; nothing if it never started."""
    if started is not None and finished is not None:
        lasted = datetime.fromisoformat(finished) - datetime.fromisoformat(started)
        durations.add(max(lasted.total_seconds(), 0.0))  # clocks may be set back

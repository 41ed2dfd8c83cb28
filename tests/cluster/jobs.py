"""The queue of one of several services, and what a test does with its jobs."""

from __future__ import annotations

from sqlalchemy import select

from service.foundation.states import ACTIVE
from service.storage.database import JobRow
from service.storage.storage import Storage
from service.training import jobs
from tests.service.data import eventually
from tests.service.jobs.conftest import new_row

LOST = {"replica_beat_s": 0.2, "replica_lost_s": 1.0}


def _request(do, options=None):
    return {"do": do, "estimator": "none", "datasets": [], "options": options or {}}


class Jobs:
    """For a queue: its own database, and the versions that it was told of."""

    def __init__(self, settings):
        self.made = []
        super().__init__(Storage.open(settings), lambda *made: self.made.append(made))

    def add(self, name, do, **options):
        with self.database.transaction() as session:
            session.add(new_row(name, request=_request(do, options)))
        self.submit(f"job_{name}")
        return f"job_{name}"

    def tell(self, job, do):
        with self.database.transaction() as session:
            session.scalar(select(JobRow).where(JobRow.id == job)).request = _request(do)

    def row(self, job):
        with self.database.session() as session:
            return session.scalar(select(JobRow).where(JobRow.id == job))

    def running(self, job, attempt=1):
        """Wait for an attempt's first sign of life."""
        return eventually(
            lambda: (
                (row := self.row(job)).state == "running"
                and row.attempts == attempt
                and "process" in row.progress
                and row
            )
        )

    def ended(self, job):
        return eventually(lambda: (row := self.row(job)).state not in ACTIVE and row)

    def cancel(self, job):
        jobs.cancel(self, job)


def said(row):
    return [entry["message"] for entry in row.history]

"""A job queue of its own, whose training processes run a function of the test."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any

import pytest
from sqlalchemy import select

from lipserve.states import ACTIVE, QUEUED
from service.foundation.settings import Settings
from service.storage.database import Database, JobRow, now
from service.storage.disk import Disk
from service.storage.files import Files
from service.storage.storage import Storage
from service.training import lifecycle, queue
from service.training.lifecycle import LIMITS, JobLimits
from service.training.queue import JobQueue
from tests.service.data import eventually

DATABASE_TIMEOUT_S = 0.2


class JobReader:
    """Reads the jobs of its `database`."""

    database: Database

    def row(self, job: str) -> JobRow:
        """Return a job as it is now."""
        with self.database.session() as session:
            return session.scalar(select(JobRow).where(JobRow.id == job))

    def running(self, job: str, attempt: int = 1) -> JobRow:
        """Wait for an attempt's first heartbeat."""

        def look() -> JobRow | None:
            row = self.row(job)
            return row if (row.state, row.attempts) == ("running", attempt) and "process" in row.progress else None

        return eventually(look)

    def ended(self, job: str) -> JobRow:
        """Wait for the end of a job."""
        return eventually(lambda: (row := self.row(job)).state not in ACTIVE and row)


def messages_of(row: JobRow) -> list[str]:
    """Return the messages of a job's history."""
    return [entry["message"] for entry in row.history]


class QueueHarness(JobReader):
    """A queue with a database of its own."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.database = Database(settings.home, DATABASE_TIMEOUT_S)
        self.made: list[tuple[str, int]] = []
        storage = Storage(settings, self.database, Files.of(settings), Disk(settings))
        self.queue = JobQueue(storage, lambda *made: self.made.append(made))

    def add(self, name: str, **values: Any) -> str:
        """Add a queued job of that name without submitting it."""
        with self.database.transaction() as session:
            session.add(new_row(name, **values))
        return f"job_{name}"

    def submit(self, name: str) -> str:
        """Add a job of that name and submit it to the queue."""
        job = self.add(name)
        self.queue.submit(job)
        return job

    def cancel(self, job: str) -> None:
        """Request the cancellation of a running job, as the service does."""
        with self.database.transaction() as session:
            session.scalar(select(JobRow).where(JobRow.id == job)).cancel_requested = True


def new_row(name: str, **values: Any) -> JobRow:
    """Return the row of a queued job."""
    usual = {"state": QUEUED, "model": name, "request": {}, "progress": {"stage": "waiting"}, "created_at": now()}
    return JobRow(id=f"job_{name}", **{**usual, "attempts": 0, "cancel_requested": False, "history": [], **values})


@pytest.fixture
def start_queue(home, monkeypatch) -> Iterator[Callable[..., QueueHarness]]:
    """Return a function that starts a queue, given a function for its processes and settings."""
    monkeypatch.setattr(queue, "WATCH_S", 0.05)
    with ExitStack() as stack:

        def start(run: Callable[[Settings, str], None], limits: JobLimits = LIMITS, **settings: Any) -> QueueHarness:
            monkeypatch.setattr(queue, "worker", SimpleNamespace(run=run))
            monkeypatch.setattr(lifecycle, "LIMITS", limits)
            made = QueueHarness(Settings(home=home, training_niceness=0, **settings))
            stack.callback(made.database.close)
            stack.callback(made.queue.close)
            return made

        yield start

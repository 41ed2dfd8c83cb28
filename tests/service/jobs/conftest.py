"""A queue of jobs on its own, whose training processes do what a test wants."""

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


class Seen:
    """Looks at the jobs of its `database`."""

    database: Database

    def row(self, job: str) -> JobRow:
        """A job as it is now."""
        with self.database.session() as session:
            return session.scalar(select(JobRow).where(JobRow.id == job))

    def running(self, job: str, attempt: int = 1) -> JobRow:
        """Wait for an attempt's first sign of life."""

        def look() -> JobRow | None:
            row = self.row(job)
            return row if (row.state, row.attempts) == ("running", attempt) and "process" in row.progress else None

        return eventually(look)

    def ended(self, job: str) -> JobRow:
        """Wait for the end of a job."""
        return eventually(lambda: (row := self.row(job)).state not in ACTIVE and row)


def messages_of(row: JobRow) -> list[str]:
    """What has happened to a job, in words."""
    return [entry["message"] for entry in row.history]


class Bench(Seen):
    """A queue with a database of its own."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.database = Database(settings.home, DATABASE_TIMEOUT_S)
        self.made: list[tuple[str, int]] = []
        storage = Storage(settings, self.database, Files.of(settings), Disk(settings))
        self.queue = JobQueue(storage, lambda *made: self.made.append(made))

    def add(self, name: str, **values: Any) -> str:
        """A queued job of that name that nobody has been told of."""
        with self.database.transaction() as session:
            session.add(new_row(name, **values))
        return f"job_{name}"

    def submit(self, name: str) -> str:
        """A job of that name, handed to the queue."""
        job = self.add(name)
        self.queue.submit(job)
        return job

    def cancel(self, job: str) -> None:
        """Wish a running job to end, as the service does."""
        with self.database.transaction() as session:
            session.scalar(select(JobRow).where(JobRow.id == job)).cancel_requested = True


def new_row(name: str, **values: Any) -> JobRow:
    """A job as it is queued."""
    usual = {"state": QUEUED, "model": name, "request": {}, "progress": {"stage": "waiting"}, "created_at": now()}
    return JobRow(id=f"job_{name}", **{**usual, "attempts": 0, "cancel_requested": False, "history": [], **values})


@pytest.fixture
def bench(home, monkeypatch) -> Iterator[Callable[..., Bench]]:
    """Starts a queue with a function for its processes, and settings."""
    monkeypatch.setattr(queue, "WATCH_S", 0.05)
    with ExitStack() as stack:

        def start(run: Callable[[Settings, str], None], limits: JobLimits = LIMITS, **settings: Any) -> Bench:
            monkeypatch.setattr(queue, "worker", SimpleNamespace(run=run))
            monkeypatch.setattr(lifecycle, "LIMITS", limits)
            made = Bench(Settings(home=home, training_niceness=0, **settings))
            stack.callback(made.database.close)
            stack.callback(made.queue.close)
            return made

        yield start

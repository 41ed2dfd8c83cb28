"""A job queue of its own, whose training processes run a function of the test, and jobs without processes."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import chain, repeat
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import DEFAULT, Mock

import pytest
from sqlalchemy import select

from lipserve.states import ACTIVE, QUEUED
from service.foundation.settings import Settings
from service.storage.database import Database, JobRow, now
from service.storage.disk import Disk
from service.storage.files import Files
from service.storage.storage import Storage
from service.training import lifecycle, queue, worker
from service.training.lifecycle import LIMITS, JobLimits
from service.training.queue import JobQueue
from tests.service import data
from tests.service.data import error, eventually, service_of

DATABASE_TIMEOUT_S = 0.2


class JobReader:
    """Reads and changes the jobs of its `database`."""

    database: Database

    def change(self, job: str, **values: Any) -> None:
        """Change values of a job."""
        with self.database.transaction() as session:
            row = session.scalar(select(JobRow).where(JobRow.id == job))
            for name, value in values.items():
                setattr(row, name, value)

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


class JobTable(JobReader):
    """The jobs of a database."""

    def __init__(self, database: Database) -> None:
        self.database = database

    def add(self, name: str, **values: Any) -> str:
        """Add a queued job of that name without submitting it; return its id."""
        with self.database.transaction() as session:
            session.add(new_row(name, **values))
        return f"job_{name}"


class QueueHarness(JobTable):
    """A queue with a database of its own."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(Database(settings.home, DATABASE_TIMEOUT_S))
        self.settings = settings
        self.made: list[tuple[str, int]] = []
        storage = Storage(settings, self.database, Files.of(settings), Disk(settings))
        self.queue = JobQueue(storage, lambda *made: self.made.append(made))

    def submit(self, name: str) -> str:
        """Add a job of that name and submit it to the queue."""
        job = self.add(name)
        self.queue.submit(job)
        return job


def new_row(name: str, **values: Any) -> JobRow:
    """Return the row of a queued job."""
    usual = {"state": QUEUED, "model": name, "request": {}, "progress": {"stage": "waiting"}, "created_at": now()}
    return JobRow(id=f"job_{name}", **{**usual, "attempts": 0, "cancel_requested": False, "history": [], **values})


def fail_at_first(function: Callable[..., Any], *errors: Exception) -> Mock:
    """Return a function that raises these errors in its first calls, and then calls `function`."""
    return Mock(wraps=function, side_effect=chain(errors, repeat(DEFAULT)))


def version_of(api: Any, model: str, number: int = 1) -> Any:
    """Return a version of a model."""
    return api.get(f"/v1/models/{model}/versions/{number}").json()


def assert_invalid(answer: Any, field: str, message: str = "") -> None:
    """Check that a request is rejected because of a field, with these words."""
    reply = error(answer, 422, "invalid_request")
    assert reply["detail"][0]["field"] == field
    assert message in reply["message"]


def refresh(api: Any, model: str) -> dict[str, Any]:
    """Refresh a model; return the succeeded job."""
    answer = api.post(f"/v1/models/{model}/refresh", json={})
    assert answer.status_code == 202, answer.text
    seen = data.ended(api, answer.json()["id"])
    assert seen["state"] == "succeeded", seen
    return seen


@pytest.fixture
def run_here(api: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], dict[str, Any]]:
    """Leave queued jobs in the queue; return a function that runs one in this process and returns it."""
    service = service_of(api)
    monkeypatch.setattr(service.jobs, "submit", lambda job: None)

    def run(name: str) -> dict[str, Any]:
        worker.run(service.settings, name)
        return data.job(api, name)

    return run


@pytest.fixture
def table(home: Path) -> Iterator[JobTable]:
    """An empty table of jobs in a database of its own."""
    jobs = JobTable(Database.of(Settings(home=home)))
    yield jobs
    jobs.database.close()


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

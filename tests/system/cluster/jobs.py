"""Job queues of several services, and the actions that tests give to their jobs."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from sqlalchemy import select

from service.storage.database import JobRow
from service.storage.storage import Storage
from service.training import jobs
from tests.service.training.conftest import JobReader, new_row
from tests.system.cluster.servers import Shared

LOST = {"replica_lost_s": 1.0}


def _request(do, options=None):
    return {"do": do, "estimator": "none", "datasets": [], "options": options or {}}


class Jobs(JobReader):
    """Adds to a queue its own database, and the versions that it was notified of."""

    def __init__(self, settings):
        self.made = []
        super().__init__(Storage.open(settings), lambda *made: self.made.append(made))

    def add(self, name, do, **options):
        with self.database.transaction() as session:
            session.add(new_row(name, request=_request(do, options)))
        self.submit(f"job_{name}")
        return f"job_{name}"

    def set_action(self, job, do):
        with self.database.transaction() as session:
            session.scalar(select(JobRow).where(JobRow.id == job)).request = _request(do)

    def cancel(self, job):
        jobs.cancel(self, job)


@contextmanager
def queues(kind: type, shared: Shared, **usual: Any) -> Iterator[Callable[..., Any]]:
    """Return a function that makes queues of a kind, for services with a home of that name and these settings."""

    class Queue(Jobs, kind):
        pass

    made = []

    def new(name: str, **settings: Any) -> Queue:
        made.append(Queue(shared.settings(name, **LOST | usual | settings)))
        made[-1].recover()
        return made[-1]

    try:
        yield new
    finally:
        for each in made:
            each.close()
            each.database.close()

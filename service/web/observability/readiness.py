"""Whether the service can do what it is for: each part is looked at, and named."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from sqlalchemy import func, select, text

from service.foundation.states import QUEUED, RUNNING
from service.models import registry
from service.storage.database import JobRow, ModelRow, VersionRow

if TYPE_CHECKING:
    from service.context import Service

State = Literal["ok", "warning", "failed"]

KEPT_S = 1.0
"""Seconds for which a report holds: however many ask, a part is looked at once in this time."""
WRITE_S = 2.0
"""Longest wait in s for another writer of the database: commits take milliseconds."""
RESTART_S = 10.0
"""Time in s within which a learner process that died should have been started again."""
START_S = 60.0
"""Time in s within which a job should have been started where a training process is free."""
PROBE = bytes(4096)


@dataclass(frozen=True)
class Check:
    """One part: warning where some clients may notice, failed where the service should get no requests."""

    name: str
    state: State
    message: str


@dataclass(frozen=True)
class Report:
    """All parts, as they were when they were looked at last."""

    checks: tuple[Check, ...]

    @property
    def failed(self) -> list[Check]:
        """Parts that keep the service from being ready."""
        return [each for each in self.checks if each.state == "failed"]


class Readiness:
    """Looks at the parts of a service, at most once every KEPT_S; safe from several threads, not for the event loop.

    clock: seconds that only rise.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._lock = clock, threading.Lock()
        self._report, self._until = Report(()), -float("inf")
        self._wrong_since: dict[str, float] = {}

    def report(self, service: Service) -> Report:
        """What was found, just now or within the last KEPT_S; never raises."""
        with self._lock:
            if self._clock() >= self._until:
                self._report = Report(tuple(self._look(service)))
                self._until = self._clock() + KEPT_S
            if service.stopping.begun:
                return Report((Check("stopping", "failed", "the service is stopping"), *self._report.checks))
            return self._report

    def forget(self) -> None:
        """Look again when asked next."""
        with self._lock:
            self._until = -float("inf")

    def _look(self, service: Service) -> list[Check]:
        looks: dict[str, Callable[[Service], tuple[State, str]]] = {
            "database": _database,
            "home": _home,
            **({"files": _files} if service.files.shared else {}),
            "models": _models,
            "learner": self._learner,
            "training": self._training,
        }
        found = []
        for name, look in looks.items():
            try:
                found.append(Check(name, *look(service)))
            except Exception as error:  # whatever it is, the part does not work
                said = getattr(error, "strerror", None) or error  # without paths: whoever reads this needs no key
                found.append(Check(name, "failed", f"{type(error).__name__}: {said}"))
        return found

    def _learner(self, service: Service) -> tuple[State, str]:
        learner = service.updates.learner
        if not learner.wanted:
            return "ok", "not needed yet"
        gone = self._lasting("learner", learner.pid is None)
        if gone is None:
            return "ok", "runs"
        if gone <= RESTART_S:
            return "warning", "is being started"
        return "failed", f"has not run for {gone:.0f} s: observations are stored, but not learnt"

    def _training(self, service: Service) -> tuple[State, str]:
        """Whether queued jobs are started: what keeps processes from starting shows in that, whatever it is."""
        with service.database.session() as session:
            found = session.execute(select(JobRow.state, func.count()).group_by(JobRow.state))
            counts = dict(found.all())
        waiting, running = counts.get(QUEUED, 0), counts.get(RUNNING, 0)
        said = f"{waiting} jobs wait, {running} run"
        if (cluster := service.jobs.cluster) is not None:  # what serves can do without
            if cluster.problem is not None:
                return "warning", f"{cluster.problem}; {said}"
            none = waiting > 0 and cluster.jobs == 0
            return ("warning" if none else "ok"), f"{said}, the cluster takes {cluster.jobs} at a time"
        stuck = self._lasting("training", waiting > 0 and running < service.settings.training_workers)
        if stuck is None or stuck <= START_S:
            return "ok", said
        return "failed", f"{waiting} jobs wait, though no more than {running} have run for {stuck:.0f} s"

    def _lasting(self, what: str, wrong: bool) -> float | None:
        """For how many seconds something has been wrong whenever it was looked at, None where it is not."""
        if not wrong:
            self._wrong_since.pop(what, None)
            return None
        return self._clock() - self._wrong_since.setdefault(what, self._clock())


def _database(service: Service) -> tuple[State, str]:
    with service.database.session() as session:
        session.execute(text("SELECT 1"))
    service.database.adapter.check(WRITE_S)
    return "ok", "can be read and written"


def _home(service: Service) -> tuple[State, str]:
    path = service.files.upload()
    try:
        path.write_bytes(PROBE)
    finally:
        path.unlink(missing_ok=True)
    shortage = service.disk.usage().shortage()
    return ("ok", "can be written") if shortage is None else ("failed", shortage)


def _files(service: Service) -> tuple[State, str]:
    """Whether the shared store answers: without it, what is in memory and what has a copy here still does."""
    try:
        service.files.check()
    except OSError as error:
        return "warning", f"{error.strerror or error}: nothing can be uploaded, trained or loaded"
    return "ok", "the shared store answers"


def _models(service: Service) -> tuple[State, str]:
    """Whether the versions that serve can be read: in memory, or their files are there and were not found damaged."""
    with service.database.session() as session:
        names = list(session.scalars(select(ModelRow.name)))
        rows = session.execute(select(VersionRow.model, VersionRow.version, VersionRow.folder))
        folders = {(model, version): folder for model, version, folder in rows}
    loaded, unreadable = service.loaded.versions(), service.loaded.unreadable()
    lost = 0
    for model, serving in registry.serving(service.database, names).items():
        key = model, serving.version
        if key not in loaded and (key in unreadable or not service.files.has_version(folders.get(key, ""))):
            lost += 1
    if not lost:
        return "ok", f"{len(names)} can be read"
    state: State = "failed" if lost == len(names) else "warning"
    return state, f"{lost} of {len(names)} cannot be read: `lipserve verify` names them"

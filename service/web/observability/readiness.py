"""Whether the service can do what it is for: each part is looked at, and named; whether it is about to stop; and what
the API tells of it."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import Annotated, Literal, Protocol

from fastapi import APIRouter, Depends
from pydantic import BaseModel, Field

from lipcore.extras import EXTRAS, install_line, installed
from lipserve.states import PartState
from service import __version__
from service.foundation.errors import NotReadyError, problem, responses
from service.foundation.fields import of_app
from service.web.route import Route


class Stopping:
    """begun: the service was told to stop, and says so, though it may still answer.

    closing: set when it takes no more connections: who would answer for long, as with events, ends now.
    """

    def __init__(self) -> None:
        self.begun = False
        self.closing = asyncio.Event()


StoppingDep = Annotated[Stopping, Depends(of_app("stopping"))]


KEPT_S = 1.0
"""Seconds for which a report holds: however many ask, a part is looked at once in this time."""


class Lasting(Protocol):
    """For how many seconds something has been wrong whenever it was looked at; None where it is not wrong now."""

    def __call__(self, wrong: bool, what: str = "") -> float | None:
        """wrong: whether it is so now; what: it is, where a part asks for several things."""
        ...


Look = Callable[[Lasting], tuple[PartState, str]]
"""Looks at one part and says in words how it is; may raise whatever the part raises."""


@dataclass(frozen=True)
class Check:
    """One part: warning where some clients may notice, failed where the service should get no requests."""

    name: str
    state: PartState
    message: str


class Readiness:
    """Looks at the parts of a service, at most once every KEPT_S; safe from several threads, not for the event loop.

    looks: of each part, by its name; clock: seconds that only rise.
    """

    def __init__(
        self, looks: Mapping[str, Look], stopping: Stopping, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.looks, self._stopping = looks, stopping
        self._clock, self._lock = clock, threading.Lock()
        self._report, self._until = tuple[Check, ...](), -float("inf")
        self._wrong_since: dict[tuple[str, str], float] = {}

    def report(self) -> tuple[Check, ...]:
        """How all parts are, just now or within the last KEPT_S; never raises."""
        with self._lock:
            if self._clock() >= self._until:
                self._report = tuple(self._check(name, look) for name, look in self.looks.items())
                self._until = self._clock() + KEPT_S
            if self._stopping.begun:
                return Check("stopping", "failed", "the service is stopping"), *self._report
            return self._report

    def forget(self) -> None:
        """Look again when asked next."""
        with self._lock:
            self._until = -float("inf")

    def _check(self, name: str, look: Look) -> Check:
        try:
            return Check(name, *look(partial(self._lasting, name)))
        except Exception as error:  # whatever it is, the part does not work
            reason = getattr(error, "strerror", None) or error  # without paths: whoever reads this needs no key
            return Check(name, "failed", f"{type(error).__name__}: {reason}")

    def _lasting(self, part: str, wrong: bool, what: str = "") -> float | None:
        if not wrong:
            self._wrong_since.pop((part, what), None)
            return None
        return self._clock() - self._wrong_since.setdefault((part, what), self._clock())


ReadinessDep = Annotated[Readiness, Depends(of_app("readiness"))]


class Live(BaseModel):
    """The process answers."""

    status: Literal["alive"] = "alive"


class Part(BaseModel):
    """One part of the service."""

    name: str = Field(examples=["database"])
    state: Literal["ok", "warning"] = Field(description="warning: some clients may notice something")
    message: str = Field(examples=["can be read and written"])


class Ready(BaseModel):
    """The service can do what it is for."""

    status: Literal["ready"] = "ready"
    version: str
    checks: list[Part]


class Missing(BaseModel):
    """What the service cannot do for want of an extra."""

    extra: str = Field(examples=["ingest"])
    gives: str = Field(description="What it is for, in words", examples=["use URDFs"])
    install: str = Field(
        description="What installs it, where the service runs", examples=["pip install 'lipserve[ingest]'"]
    )


class Health(BaseModel):
    """The process answers, and what it can do."""

    status: Literal["alive"] = "alive"
    version: str
    can: dict[str, bool] = Field(
        description="What is installed besides serving, teaching and training of learnt arms, by the name of its "
        "extra: " + "; ".join(f"`{name}`, to {extra.gives}" for name, extra in EXTRAS.items()),
        examples=[{"train": True, "robots": True, "ingest": False}],
    )
    missing: list[Missing] = Field(description="Of what is not installed")
    confined: dict[str, bool] = Field(
        {},
        description="What this system has to keep the process in which an upload is read from harm: limits of `memory` "
        "and `processor`; `landlock`, from files; `seccomp`, from the network and other processes",
        examples=[{"memory": True, "processor": True, "landlock": True, "seccomp": True}],
    )


router = APIRouter(prefix="/health", tags=["health"], route_class=Route)


@router.get("", summary="What can the service do?")
async def health(confined: Annotated[dict[str, bool], Depends(of_app("confined"))]) -> Health:
    """Answer which extras are installed. Who asks for what needs another one is answered 501 `not_installed`."""
    return Health(version=__version__, can=dict(_can()), missing=list(_missing()), confined=confined)


@cache
def _can() -> tuple[tuple[str, bool], ...]:
    """Of every extra whether it is installed: looked up once, as a running service does not see what is new."""
    return tuple((name, installed(name)) for name in EXTRAS)


def _missing() -> Iterator[Missing]:
    for name, there in _can():
        if not there:
            yield Missing(extra=name, gives=EXTRAS[name].gives, install=install_line(name))


@router.get("/live", summary="Is the process alive?")
async def live() -> Live:
    """Answer while the event loop turns."""
    return Live()


@router.get("/ready", summary="Can the service answer?", responses=responses(NotReadyError))
def ready(readiness: ReadinessDep) -> Ready:
    """Answer once the models are loaded, and while each part works: the database and the home can be written and are
    not full, the versions that serve can be read, the learner gets on where something learns, training jobs are
    started, and the service is not stopping. Otherwise `detail` names the parts that do not. Looked at once a second
    at most.
    """
    report = readiness.report()
    if failed := [each for each in report if each.state == "failed"]:
        message = "; ".join(f"{each.name}: {each.message}" for each in failed)
        raise NotReadyError(message, [problem(each.name, each.message, "ok") for each in failed])
    checks = [Part(name=each.name, state=each.state, message=each.message) for each in report]
    return Ready(version=__version__, checks=checks)

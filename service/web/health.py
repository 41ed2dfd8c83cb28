"""Health as the API tells it."""

from __future__ import annotations

from typing import Literal

from fastapi import APIRouter
from pydantic import BaseModel, Field

from service import __version__
from service.foundation.errors import NotReadyError, problem, responses
from service.web.observability.readiness import ReadinessDep
from service.web.route import Route


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


router = APIRouter(prefix="/health", tags=["health"], route_class=Route)


@router.get("/live", summary="Is the process alive?")
async def live() -> Live:
    """Answer while the event loop turns."""
    return Live()


@router.get("/ready", summary="Can the service answer?", responses=responses(NotReadyError))
def ready(readiness: ReadinessDep) -> Ready:
    """Answer once the models are loaded, and while each part works: the database and the home can be written and are
    not full, the versions that serve can be read, the learner runs where something learns, training jobs are started,
    and the service is not stopping. Otherwise `detail` names the parts that do not. Looked at once a second at most.
    """
    report = readiness.report()
    if report.failed:
        message = "; ".join(f"{each.name}: {each.message}" for each in report.failed)
        raise NotReadyError(message, [problem(each.name, each.message, "ok") for each in report.failed])
    checks = [Part(name=each.name, state=each.state, message=each.message) for each in report.checks]
    return Ready(version=__version__, checks=checks)

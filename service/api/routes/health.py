"""Health routes for monitoring, which need no API key."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Annotated

from fastapi import APIRouter, Depends
from starlette.types import Scope

from lipcore.extras import EXTRAS, install_line, is_installed
from service import __version__
from service.api.access.scopes import needs
from service.api.dependencies import ReadinessDep, of_app
from service.api.errors import responses
from service.api.route import Reply, Route
from service.contract.health import Health, Live, Missing, Part, Ready
from service.foundation.errors import NotReadyError, problem

router = APIRouter(prefix="/health", tags=["health"], route_class=Route)


@router.get("", summary="Retrieve version and installed extras")
@needs(None)
async def health(confined: Annotated[dict[str, bool], Depends(of_app("confined"))]) -> Health:
    """Return the version and which optional extras are installed.

    A request that needs a missing extra is answered with 501 `not_installed`.
    """
    return Health(version=__version__, can=dict(_can()), missing=list(_missing()), confined=confined)


@cache
def _can() -> tuple[tuple[str, bool], ...]:
    """Return for every extra whether it is installed. Cached: a running service cannot import a new package."""
    return tuple((name, is_installed(name)) for name in EXTRAS)


def _missing() -> Iterator[Missing]:
    for name, there in _can():
        if not there:
            yield Missing(extra=name, gives=EXTRAS[name].gives, install=install_line(name))


async def answer_live(scope: Scope, body: bytes) -> Reply:
    """Answer `live` in the event loop of another process."""
    return Reply(Live().model_dump_json().encode())


@router.get("/live", summary="Check that the process is alive")
@needs(None)
async def live() -> Live:
    """Answer 200 while the event loop runs."""
    return Live()


@router.get("/ready", summary="Check that the service is ready", responses=responses(NotReadyError))
@needs(None)
def ready(readiness: ReadinessDep) -> Ready:
    """Answer 200 if the models are loaded and every part of the service works, else 503.

    - The database and the home folder can be written and are not full.
    - The serving versions can be read.
    - The learner makes progress, if a model learns.
    - Training jobs are started.
    - The service is not stopping.

    With 503, `detail` names the parts that failed. The parts are checked at most once a second.
    """
    report = readiness.report()
    if failed := [each for each in report if each.state == "failed"]:
        message = "; ".join(f"{each.name}: {each.message}" for each in failed)
        raise NotReadyError(message, [problem(each.name, each.message, "ok") for each in failed])
    checks = [Part(name=each.name, state=each.state, message=each.message) for each in report]
    return Ready(version=__version__, checks=checks)

"""Routes of health: for what watches over the service, without a key."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Annotated

from fastapi import APIRouter, Depends

from lipcore.extras import EXTRAS, install_line, is_installed
from service import __version__
from service.api.access.scopes import needs
from service.api.dependencies import ReadinessDep, of_app
from service.api.errors import responses
from service.api.route import Route
from service.contract.health import Health, Live, Missing, Part, Ready
from service.foundation.errors import NotReadyError, problem

router = APIRouter(prefix="/health", tags=["health"], route_class=Route)


@router.get("", summary="What can the service do?")
@needs(None)
async def health(confined: Annotated[dict[str, bool], Depends(of_app("confined"))]) -> Health:
    """Answer which extras are installed. Who asks for what needs another one is answered 501 `not_installed`."""
    return Health(version=__version__, can=dict(_can()), missing=list(_missing()), confined=confined)


@cache
def _can() -> tuple[tuple[str, bool], ...]:
    """Of every extra whether it is installed: looked up once, as a running service does not see what is new."""
    return tuple((name, is_installed(name)) for name in EXTRAS)


def _missing() -> Iterator[Missing]:
    for name, there in _can():
        if not there:
            yield Missing(extra=name, gives=EXTRAS[name].gives, install=install_line(name))


@router.get("/live", summary="Is the process alive?")
@needs(None)
async def live() -> Live:
    """Answer while the event loop turns."""
    return Live()


@router.get("/ready", summary="Can the service answer?", responses=responses(NotReadyError))
@needs(None)
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

"""Health: is the process alive, and can it answer."""

from __future__ import annotations

from fastapi import APIRouter

from service import __version__
from service.foundation.errors import NotReadyError, problem, responses
from service.web.health_schema import Live, Part, Ready
from service.web.observability.readiness import ReadinessDep
from service.web.route import Route

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

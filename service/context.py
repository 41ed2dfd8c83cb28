"""What the routes of one running service share."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from anyio import CapacityLimiter
from fastapi import Depends, Request

from service.foundation.settings import Settings
from service.learning.updates import Updates
from service.models.loaded import LoadedModels
from service.storage.database import Database
from service.storage.disk import Disk
from service.storage.files import Files
from service.training.queue import JobQueue
from service.web.limits.stopping import Stopping
from service.web.observability.meters import Meters
from service.web.observability.readiness import Readiness


@dataclass(frozen=True)
class Service:
    """The parts of a running service; made when it starts, closed when it stops."""

    settings: Settings
    database: Database
    files: Files
    loaded: LoadedModels
    jobs: JobQueue
    predictions: CapacityLimiter
    updates: Updates
    disk: Disk
    stopping: Stopping
    meters: Meters = field(default_factory=Meters)
    readiness: Readiness = field(default_factory=Readiness)
    uploads: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(2))
    archives: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(1))


async def _service(request: Request) -> Service:
    service: Service = request.app.state.service
    return service


ServiceDep = Annotated[Service, Depends(_service)]

"""Health: is the process alive, and can it answer."""

from __future__ import annotations

from typing import Literal

from fastapi import APIRouter
from pydantic import BaseModel
from sqlalchemy import text

from service import __version__
from service.context import ServiceDep
from service.errors import NotReadyError, responses

router = APIRouter(prefix="/health", tags=["health"])


class Live(BaseModel):
    """The process answers."""

    status: Literal["alive"] = "alive"


class Ready(BaseModel):
    """The service can answer queries."""

    status: Literal["ready"] = "ready"
    version: str


@router.get("/live", summary="Is the process alive?")
async def live() -> Live:
    """Answer while the event loop turns."""
    return Live()


@router.get("/ready", summary="Can the service answer?", responses=responses(NotReadyError))
def ready(service: ServiceDep) -> Ready:
    """Answer once the models are loaded and while the database answers."""
    try:
        with service.database.session() as session:
            session.execute(text("SELECT 1"))
    except Exception as error:
        raise NotReadyError(f"the database does not answer: {error}") from error
    return Ready(version=__version__)

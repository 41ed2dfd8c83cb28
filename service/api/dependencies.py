"""Dependencies of endpoints: parts of the application, pages of lists, and the idempotency key."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Annotated, Any

from anyio import CapacityLimiter
from fastapi import Depends, Header, Query, Request

from service.foundation.errors import invalid_request
from service.learning.learners import Learners
from service.models.loaded import LoadedModels
from service.storage.rows import DEFAULT_PAGE, HEADER, MAX_PAGE, Page
from service.storage.storage import Storage
from service.telemetry.meters import Meters
from service.telemetry.readiness import Readiness, StopState
from service.training.queue import JobQueue


def of_app(name: str) -> Callable[[Request], Awaitable[Any]]:
    """Return a dependency that reads an attribute of the application's state."""

    async def kept(request: Request) -> Any:
        return getattr(request.app.state, name)

    return kept


def _turns_of(kind: str) -> Callable[[Request], Awaitable[CapacityLimiter]]:
    async def limiter(request: Request) -> CapacityLimiter:
        kind_limiter: CapacityLimiter = getattr(request.app.state.turns, kind)
        return kind_limiter

    return limiter


StorageDep = Annotated[Storage, Depends(of_app("storage"))]
LoadedModelsDep = Annotated[LoadedModels, Depends(of_app("loaded"))]
JobQueueDep = Annotated[JobQueue, Depends(of_app("jobs"))]
LearnersDep = Annotated[Learners, Depends(of_app("learners"))]
PredictionsDep = Annotated[CapacityLimiter, Depends(_turns_of("predictions"))]
UploadsDep = Annotated[CapacityLimiter, Depends(_turns_of("uploads"))]
ArchivesDep = Annotated[CapacityLimiter, Depends(_turns_of("archives"))]
MetersDep = Annotated[Meters, Depends(of_app("meters"))]
ReadinessDep = Annotated[Readiness, Depends(of_app("readiness"))]
StoppingDep = Annotated[StopState, Depends(of_app("stopping"))]


def _page(
    limit: Annotated[int | None, Query(ge=1, description=f"Max items per page. Default: {DEFAULT_PAGE}")] = None,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the previous page")] = None,
) -> Page:
    if limit is None:
        limit = min(DEFAULT_PAGE, MAX_PAGE)
    if limit > MAX_PAGE:
        raise invalid_request("limit", limit, f"at most {MAX_PAGE}")
    if cursor is not None and not (cursor.isascii() and cursor.isdigit() and len(cursor) < 18):
        raise invalid_request("cursor", cursor, "the next_cursor of a page")
    return Page(after=None if cursor is None else int(cursor), limit=limit)


PageQuery = Annotated[Page, Depends(_page)]

KeyHeader = Annotated[
    str | None,
    Header(
        alias=HEADER,
        max_length=100,
        pattern=r"^[!-~]+$",
        description="A unique key of this request, chosen by the client: printable characters without spaces. With it, "
        "the request can be retried if the answer is lost: it runs once, and every retry returns the same result. "
        "Another request with the same key is answered 409",
    ),
]

"""How many requests of a kind may compute at once; others wait for their turn."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Annotated

from anyio import CapacityLimiter
from fastapi import Depends, Request


@dataclass(frozen=True)
class Turns:
    """One limiter a kind; to be made where an event loop runs."""

    predictions: CapacityLimiter
    uploads: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(2))
    archives: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(1))


def _of(kind: str) -> Callable[[Request], Awaitable[CapacityLimiter]]:
    async def limiter(request: Request) -> CapacityLimiter:
        found: CapacityLimiter = getattr(request.app.state.turns, kind)
        return found

    return limiter


PredictionsDep = Annotated[CapacityLimiter, Depends(_of("predictions"))]
UploadsDep = Annotated[CapacityLimiter, Depends(_of("uploads"))]
ArchivesDep = Annotated[CapacityLimiter, Depends(_of("archives"))]

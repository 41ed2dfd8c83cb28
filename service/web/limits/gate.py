"""How many requests are answered at a time."""

from __future__ import annotations

from starlette.types import ASGIApp, Receive, Scope, Send

from service.foundation.errors import BusyError, refuse

HEALTH = "/health/"
"""Requests below it are always answered: a service that is busy is not one that is dead."""


class Gate:
    """Middleware that refuses requests while `most` others are answered. Streams have a limit of their own.

    open: requests that are answered now.
    """

    def __init__(self, app: ASGIApp, most: int) -> None:
        self.app, self.most, self.open = app, most, 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer it with 429."""
        if scope["type"] != "http" or (self.open >= self.most and scope["path"].startswith(HEALTH)):
            await self.app(scope, receive, send)
            return
        if self.open >= self.most:
            said = f"{self.open} requests are being answered, the most there may be (LIPSERVE_MAX_REQUESTS): try again"
            await refuse(BusyError(said, headers={"Retry-After": "1"}), scope, receive, send)
            return
        self.open += 1
        try:
            await self.app(scope, receive, send)
        finally:
            self.open -= 1

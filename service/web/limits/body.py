"""The body of a request: its largest size, announced or not, and the longest time it may take."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from time import monotonic
from typing import Any

from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOK_S = 0.5
"""Longest time in s between two looks at the bodies that are waited for."""


class BodyLimit:
    """Refuse to read more of a body than the limit, and to wait for one that comes too slowly.

    limits: most bytes by path; others: of all other paths; seconds: longest wait for a body, and one second more for
    every `bytes_per_s` that came. Only waiting counts, not what the application does between two pieces.

    Not FastAPI's `max_body_size`: to a body whose length is announced, that answers in plain text. Not a timer for
    each request either: 2 µs, where looking at all that wait now and then costs a fifth.
    """

    def __init__(
        self, app: ASGIApp, limits: Mapping[str, int], others: int, seconds: float, bytes_per_s: float
    ) -> None:
        self.app, self.limits, self.others = app, dict(limits), others
        self.seconds, self.bytes_per_s = seconds, bytes_per_s
        self._due: dict[asyncio.Task[Any], float | None] = {}  # when each ends that waits; None: it is ended
        self._looking: asyncio.AbstractEventLoop | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on; reading its body raises an answer of 413 or 408."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        limit = self.limits.get(scope["path"], self.others)
        refused = False
        for name, value in scope["headers"]:
            if name == b"content-length":
                refused = value.isdigit() and (len(value) > 18 or int(value) > limit)
        seen, waited, complete = 0, 0.0, False

        async def limited() -> Message:
            nonlocal seen, waited, complete
            if complete:  # who asks on waits for the client to go away, as long as it takes
                return await receive()
            if refused:
                raise _too_large(limit)
            task = asyncio.current_task()
            assert task is not None
            began = monotonic()
            self._due[task] = began - waited + self.seconds + seen / self.bytes_per_s
            if self._looking is not task.get_loop():
                self._look_later()
            try:
                message = await receive()
            except asyncio.CancelledError:
                if self._due[task] is None and task.uncancel() == 0:
                    raise _too_slow(seen) from None
                raise
            finally:
                del self._due[task]
            complete = not message.get("more_body", False)
            if not complete:
                waited += monotonic() - began
            seen += len(message.get("body", b""))
            if seen > limit:
                # FastAPI takes any other exception for a body that cannot be parsed
                raise _too_large(limit)
            return message

        await self.app(scope, limited, send)

    def _look_later(self) -> None:
        self._looking = asyncio.get_running_loop()
        self._looking.call_later(min(LOOK_S, self.seconds / 4), self._look)

    def _look(self) -> None:
        """End the waits that have lasted too long."""
        now = monotonic()
        for task, due in self._due.items():
            if due is not None and due <= now:
                self._due[task] = None
                task.cancel()
        self._looking = None
        if self._due:
            self._look_later()


def _too_large(limit: int) -> HTTPException:
    return HTTPException(413, f"the body has more than {limit} bytes, the most that is taken here")


def _too_slow(seen: int) -> HTTPException:
    # what else comes of the body must not be taken for the next request
    return HTTPException(408, f"the body came too slowly: {seen} bytes of it so far", {"Connection": "close"})

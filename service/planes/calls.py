"""gRPC in the data plane: it answers queries of control loops and forwards all other calls to the control plane.

Import it in the process that serves: gRPC starts threads, which do not survive a fork.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from typing import Any

from starlette.datastructures import State
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.types import Receive, Scope, Send

from service.api.access.keys import Keyring
from service.api.errors import http_error
from service.api.limits.requests import MAX_REQUESTS, PATIENCE, BodyLimit, body_limits
from service.api.oip.rpc import PortError
from service.api.oip.rpc.forwarding import Forwarding
from service.api.oip.rpc.listening import listening
from service.api.oip.rpc.methods import AT_ONCE, METHODS
from service.api.requests import HANDED_OVER
from service.api.shared import Shared
from service.foundation.errors import ServiceError
from service.foundation.settings import Settings
from service.planes.answers import DataApp, with_middleware
from service.telemetry.meters import Meters
from service.telemetry.readiness import StopState

RETRY_S, OPEN_TRIES = 0.02, 100
"""Seconds between two tries to open the port, and their number."""


class CallApp:
    """The application of calls. It marks those that the control plane answers, with all that fail.

    state: that of the data plane's application.
    """

    def __init__(self, state: State) -> None:
        self._state = state

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a call or mark it."""
        path: str = scope["path"]
        scope["route"], scope["path_params"] = METHODS[path], {}
        try:
            body = (await receive())["body"]
        except HTTPException as error:  # a limit of the message
            response = await http_error(Request(scope), error)
            await response(scope, receive, send)
            return
        answer: Any = AT_ONCE.get(path)
        try:
            reply = None if answer is None else await answer(self._state, scope, body)
        except ServiceError:
            reply = None
        if reply is None:
            scope[HANDED_OVER] = True
            return
        await send({"type": "http.response.start", "status": 200, "headers": reply.headers()})
        await send({"type": "http.response.body", "body": reply.body})


@asynccontextmanager
async def serving_calls(
    app: DataApp, settings: Settings, keyring: Keyring | None, meters: Meters, shared: Shared, stopping: StopState
) -> AsyncIterator[None]:
    """Serve calls while the context is open; raise PortError if the port stays in use."""
    assert shared.calls is not None
    limited = BodyLimit(
        CallApp(app.state), body_limits(settings), PATIENCE.body_s, PATIENCE.body_bytes_per_s, MAX_REQUESTS // 4
    )
    answering = with_middleware(app, settings, keyring, meters, shared, limited)
    forwarding = Forwarding(shared.calls)
    try:
        async with AsyncExitStack() as stack:
            await _listen(stack, lambda: listening(answering, settings, stopping, forward=forwarding.forward))
            yield
    finally:
        await forwarding.close()


async def _listen(stack: AsyncExitStack, listen: Callable[[], AbstractAsyncContextManager[int]]) -> None:
    """Open the port, which a data plane that was killed may still hold for a moment."""
    for left in reversed(range(OPEN_TRIES)):
        try:
            await stack.enter_async_context(listen())
        except PortError:
            if not left:
                raise
            await asyncio.sleep(RETRY_S)
        else:
            return

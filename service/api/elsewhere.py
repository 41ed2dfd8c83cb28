"""Computations that are too long to run beside control loops: in processes of their own, or in threads without them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Annotated, Any, Protocol, TypeVar

from fastapi import Depends, Request, Response
from pydantic import BaseModel
from starlette.datastructures import State
from starlette.types import Receive

from service.api.limits.requests import in_turn
from service.api.route import Reply, unless_disconnected
from service.storage.storage import Storage

T = TypeVar("T")
Asked = TypeVar("Asked", bound=BaseModel)


class NoWorkerError(RuntimeError):
    """No worker can be started."""


class Workers(Protocol):
    """Processes that compute."""

    async def run(self, function: Callable[..., T], served: Any, *given: Any) -> T:
        """Return `function(storage, served, *given)`. Cancel it to end the computation. Raise NoWorkerError."""


class Elsewhere:
    """Runs functions of a storage, a version and more, in the processes of the service or in its threads.

    function: one of a module. A process imports it, with the storage of that process.
    """

    def __init__(self, state: State, receive: Receive | None = None) -> None:
        """Read the parts of the application.

        receive: of the request. A computation ends if the client disconnects, None: only if it is cancelled.
        """
        self._state, self._receive = state, receive

    async def run(self, function: Callable[..., T], served: Any, *given: Any, short: bool = False) -> T:
        """Return the result of the function; raise its errors, or ClientDisconnect.

        short: whether it is shorter than the way to a process, and runs in a thread.
        """
        workers: Workers | None = self._state.workers
        if workers is not None and not short:
            with suppress(NoWorkerError):
                computing = workers.run(function, served, *given)
                return await (computing if self._receive is None else unless_disconnected(self._receive, computing))
        return await in_turn(self._state.turns.predictions, function, self._state.storage, served, *given)

    async def answer(
        self, function: Callable[[Storage, Any, Asked], BaseModel], served: Any, request: Asked, short: bool = False
    ) -> Response:
        """Return the response with the result of the function, which is encoded where it is computed."""
        return Reply(await self.run(partial(_encoded, function), served, request, short=short)).response()


def _encoded(function: Callable[..., BaseModel], *given: Any) -> bytes:
    return function(*given).model_dump_json().encode()


async def _elsewhere(request: Request) -> Elsewhere:
    return Elsewhere(request.app.state, request.receive)


ElsewhereDep = Annotated[Elsewhere, Depends(_elsewhere)]

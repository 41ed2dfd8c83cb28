"""Answers of the control plane leave after the data plane answers with what they report: clients read their writes."""

from __future__ import annotations

import asyncio
from math import inf

from fastapi import FastAPI
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.models.changes import Changes

MAX_WAIT_S = 0.2
"""Max seconds that an answer waits for a data plane: if it hangs, its spare takes over."""


class Confirmations:
    """The number of changes with which the data plane answers. Safe to share between threads."""

    def __init__(self) -> None:
        self._changes = Changes()
        self._confirmed: float = inf
        self._loop: asyncio.AbstractEventLoop | None = None
        self._waiting: list[tuple[int, asyncio.Future[None]]] = []

    def watch(self, changes: Changes) -> None:
        """Count these changes."""
        self._changes = changes

    def confirm(self, number: float) -> None:
        """Note that the data plane answers with the changes up to a number; `inf` if no data plane answers."""
        self._confirmed = number
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._wake)

    @property
    def are_missing(self) -> bool:
        """Whether the data plane lacks a change."""
        return self._changes.number > self._confirmed

    async def wait(self) -> None:
        """Wait until the data plane answers with all changes up to now, at most MAX_WAIT_S; in one event loop."""
        self._loop = asyncio.get_running_loop()
        done = self._loop.create_future()
        entry = self._changes.number, done
        self._waiting.append(entry)
        self._wake()  # it may have been confirmed meanwhile
        try:
            await asyncio.wait_for(done, MAX_WAIT_S)
        except TimeoutError:
            pass
        finally:
            if entry in self._waiting:
                self._waiting.remove(entry)

    def _wake(self) -> None:
        for entry in [each for each in self._waiting if each[0] <= self._confirmed]:
            self._waiting.remove(entry)
            if not entry[1].done():
                entry[1].set_result(None)


class ReadYourWrites:
    """Middleware that sends each part of an answer after the data plane has all changes before it.

    It costs a comparison if nothing is missing.
    """

    def __init__(self, app: ASGIApp, confirmations: Confirmations) -> None:
        self.app, self._confirmations = app, confirmations

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return

        async def send_confirmed(message: Message) -> None:
            if self._confirmations.are_missing:
                await self._confirmations.wait()
            await send(message)

        await self.app(scope, receive, send_confirmed)


def confirm_answers(app: FastAPI) -> None:
    """Let the answers of an application wait for the data plane. `Confirmations` is in its state."""
    app.state.confirmations = Confirmations()
    app.add_middleware(ReadYourWrites, confirmations=app.state.confirmations)

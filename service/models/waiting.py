"""Queries that wait for what they have taught: read your writes, whichever service has taken the batch."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from anyio import to_thread

from service.foundation.errors import RevisionNotReachedError, problem

if TYPE_CHECKING:
    from service.models.loaded import LoadedModels
    from service.models.served import Served

AGAIN = {"Retry-After": "1"}


class Waiter:
    """A coroutine that waits for a model to answer otherwise than before."""

    def __init__(self) -> None:
        self._loop, self._changed = asyncio.get_running_loop(), asyncio.Event()

    def wake(self) -> None:
        """Say that the model answers otherwise; from any thread."""
        with suppress(RuntimeError):  # the loop has ended, and nobody waits any more
            self._loop.call_soon_threadsafe(self._changed.set)

    async def wait(self, seconds: float) -> None:
        """Wait until it does since the last time, or so long."""
        with suppress(TimeoutError):
            await asyncio.wait_for(self._changed.wait(), seconds)
        self._changed.clear()


class Waiting:
    """Who waits for which model; safe to share between threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiters: dict[str, set[Waiter]] = {}

    def tell(self, model: str) -> None:
        """Wake those that wait for a model; never waits itself."""
        with self._lock:
            waiters = tuple(self._waiters.get(model, ()))
        for waiter in waiters:
            waiter.wake()

    @contextmanager
    def waiter(self, model: str) -> Iterator[Waiter]:
        """Wait for a model; for the event loop. What happens from here on is not missed."""
        made = Waiter()
        with self._lock:
            self._waiters.setdefault(model, set()).add(made)
        try:
            yield made
        finally:
            with self._lock:
                self._waiters[model].discard(made)
                if not self._waiters[model]:
                    del self._waiters[model]


async def reached(loaded: LoadedModels, model: str, version: int | None, alias: str | None, revision: int) -> Served:
    """Return the version that answers once it has a revision, or a later one. For the event loop, which goes on.

    Raise RevisionNotReachedError after `min_revision_wait_s`; NotFoundError or UnreadableVersionError at once.
    """
    loop = asyncio.get_running_loop()
    until, asked = loop.time() + loaded.storage.settings.min_revision_wait_s, False
    with loaded.waiting.waiter(model) as waiter:
        while True:
            served = loaded.hot(model, version, alias)
            if served is None:
                served = await to_thread.run_sync(loaded.get, model, version, alias)
            if served.revision >= revision:
                return served
            if not asked:  # whoever has logged what is missing may have told nobody yet
                loaded.wake(model)
                asked = True
            left = until - loop.time()
            if left <= 0:
                raise _not_reached(served, revision)
            await waiter.wait(left)


def _not_reached(served: Served, revision: int) -> RevisionNotReachedError:
    name = f"version {served.version} of model {served.name!r}"
    said = f"{name} answers with revision {served.revision} and has not learnt up to revision {revision} yet: ask again"
    expected = f"{served.revision} or less now, of version {served.version}"
    return RevisionNotReachedError(said, [problem("min_revision", revision, expected)], AGAIN)

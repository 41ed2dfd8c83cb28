"""Limits of request rates: a token bucket per client, in memory that the processes of a service share."""

from __future__ import annotations

import mmap
from collections.abc import Hashable
from itertools import chain
from math import ceil
from time import monotonic

from starlette.types import ASGIApp, Receive, Scope, Send

from service.api.errors import refuse
from service.api.limits.requests import COUNTED, HEALTH, client_of
from service.foundation.errors import RateLimitedError

MAX_CLIENTS = 16_384
"""Max clients with a bucket of their own; the others share one."""
PLACES = 8
"""Number of places that a client's bucket may be at."""


class Buckets:
    """Token buckets of clients: the time when each is full again, by the hash of the client's name.

    A full bucket is the same as a new one, so its place is free. Processes that were forked from one count in the same
    memory, without a lock: a bucket that two of them change at a time may lose a token. Other processes hash names
    differently.
    """

    def __init__(self, max_clients: int = MAX_CLIENTS) -> None:
        self._size = max_clients
        memory = memoryview(mmap.mmap(-1, 16 * (max_clients + 1)))  # the last one: of the others
        self._names, self._full = memory[: 8 * (max_clients + 1)].cast("q"), memory[8 * (max_clients + 1) :].cast("d")

    def find(self, client: Hashable, at: float) -> tuple[int, float]:
        """Return the place of a client's bucket at a time in s, and the time when it is full."""
        name, size = hash(client) or 1, self._size
        first, free = name % size, -1
        if self._names[first] == name:
            return first, max(self._full[first], at)
        for place in chain(range(first, min(first + PLACES, size)), range(min(first, max(0, first + PLACES - size)))):
            if self._names[place] == name:
                return place, max(self._full[place], at)
            if free < 0 and self._full[place] <= at:
                free = place
        if free < 0:
            return size, max(self._full[size], at)
        self._names[free] = name
        return free, at

    def fill_by(self, place: int, full: float) -> None:
        """Set the time when a bucket is full."""
        self._full[place] = full


class Rate:
    """A rate limit of each client: at most `burst` tokens, refilled at `per_s` tokens per second.

    Rates that share buckets need different names of clients.
    """

    def __init__(self, per_s: float, burst: int, buckets: Buckets | None = None) -> None:
        self.step, self.depth = 1 / per_s, burst / per_s
        self._buckets = Buckets() if buckets is None else buckets

    def wait(self, client: Hashable, at: float) -> float:
        """Use a token at a time in s. Return 0 if there was one, else the time in s until there is one."""
        place, full = self._buckets.find(client, at)
        then = full + self.step
        if then - at > self.depth * (1 + 1e-9):
            return then - at - self.depth
        self._buckets.fill_by(place, then)
        return 0.0


class RateLimit:
    """Middleware that limits the request rate of each client. It runs inside the middleware that checks keys.

    A stream counts once, when it is opened.
    """

    def __init__(self, app: ASGIApp, per_s: float, burst: int, buckets: Buckets | None = None) -> None:
        self.app, self.per_s, self.rate = app, per_s, Rate(per_s, burst, buckets)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on or answer 429."""
        if scope["type"] == "lifespan" or COUNTED in scope or scope["path"].startswith(HEALTH):
            await self.app(scope, receive, send)
            return
        client = client_of(scope)
        wait = self.rate.wait(client, monotonic())
        if wait:
            limit = f"at most {self.per_s:g} per s (LIPSERVE_MAX_REQUESTS_PER_S)"
            message = f"Too many requests from {client}: {limit}."
            error = RateLimitedError(message, headers={"Retry-After": str(ceil(wait))})
            await refuse(error, scope, receive, send)
            return
        scope[COUNTED] = True
        await self.app(scope, receive, send)

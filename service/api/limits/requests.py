"""What requests may take: how many are answered at a time and how many of a kind compute at once, how often one client
may ask, how large a body may be and how long it may take."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from ipaddress import IPv6Address, ip_address
from math import ceil
from time import monotonic
from typing import Any, TypeVar

from anyio import CapacityLimiter, to_thread
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.errors import refuse
from service.foundation.errors import BusyError, RateLimitedError
from service.foundation.settings import Settings
from service.models.archive_reading import MAX_ARCHIVE_BYTES, MAX_URDF_BYTES
from service.telemetry.logs import KEY_ID

MAX_REQUESTS = 256
"""Max requests at a time; a quarter as many may wait for the bodies of one client. More are answered 429."""


@dataclass(frozen=True)
class ClientPatience:
    """How long the service waits for a slow client, before it closes the connection.

    header_s: for a request's line and headers, of at most `header_bytes`. body_s: for a body, and one second more for
    each `body_bytes_per_s` that came. answer_s: until the client reads any of its answer. frame_s: until it reads an
    answer of a stream.
    """

    header_s: float = 10.0
    header_bytes: int = 64 * 1024
    body_s: float = 20.0
    body_bytes_per_s: int = 1000
    answer_s: float = 30.0
    frame_s: float = 10.0


PATIENCE = ClientPatience()


def body_limits(settings: Settings) -> dict[str, int]:
    """Largest body in bytes, by path or by a path's last part; `*`: of every other path."""
    return {
        "/v1/datasets": settings.max_upload_bytes,
        "/v1/robots": MAX_URDF_BYTES,
        "/v1/models/import": MAX_ARCHIVE_BYTES,
        **dict.fromkeys(("predict", "observations", "infer", "echo"), settings.max_request_bytes),
        "*": min(256 * 1024, settings.max_request_bytes),  # a list of a thousand long names
    }


def body_limit(limits: Mapping[str, int], path: str) -> int:
    """The limit that a path has."""
    return limits.get(path) or limits.get(path.rpartition("/")[2]) or limits["*"]


class BodyLimit:
    """Refuse to read more of a body than the limit, and to wait for one that comes too slowly.

    limits: see `body_limits`; seconds: longest wait for a body, and one second more for
    every `bytes_per_s` that came. Only waiting counts, not what the application does between two pieces. at_once:
    bodies of one client that are waited for at a time; more are answered 429.

    Not FastAPI's `max_body_size`: to a body whose length is announced, that answers in plain text. Not a timer for
    each request either: 2 µs, where looking at all that wait now and then costs a fifth.
    """

    def __init__(
        self, app: ASGIApp, limits: Mapping[str, int], seconds: float, bytes_per_s: float, at_once: int
    ) -> None:
        self.app, self.limits = app, dict(limits)
        self.seconds, self.bytes_per_s, self.at_once = seconds, bytes_per_s, at_once
        self._waited_for: Counter[str] = Counter()  # bodies, by client
        self._due: dict[asyncio.Task[Any], float | None] = {}  # when each ends that waits; None: it is ended
        self._looking: asyncio.AbstractEventLoop | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on; reading its body raises an answer of 413 or 408."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        limit = body_limit(self.limits, scope["path"])
        refused = False
        for name, value in scope["headers"]:
            if name == b"content-length":
                refused = value.isdigit() and (len(value) > 18 or int(value) > limit)
        client, seen, waited, complete = client_of(scope), 0, 0.0, False

        async def limited() -> Message:
            nonlocal seen, waited, complete
            if complete:  # who asks on waits for the client to go away, as long as it takes
                return await receive()
            if refused:
                raise _too_large(limit)
            if self._waited_for[client] >= self.at_once:
                raise _too_many(client, self.at_once)
            task = asyncio.current_task()
            assert task is not None
            began = monotonic()
            self._waited_for[client] += 1
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
                self._waited_for[client] -= 1
                if not self._waited_for[client]:
                    del self._waited_for[client]
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
        self._looking.call_later(min(0.5, self.seconds / 4), self._look)

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


def _too_many(client: str, most: int) -> HTTPException:
    message = f"{most} bodies of {client} are being waited for, the most there may be: send fewer at a time"
    return HTTPException(429, message, {"Retry-After": "1", "Connection": "close"})


def _too_slow(seen: int) -> HTTPException:
    # what else comes of the body must not be taken for the next request
    return HTTPException(408, f"the body came too slowly: {seen} bytes of it so far", {"Connection": "close"})


HEALTH = "/health"
"""Requests there and below are always answered: a service that is busy is not one that is dead."""


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
            message = f"{self.open} requests are being answered, the most there may be: try again"
            await refuse(BusyError(message, headers={"Retry-After": "1"}), scope, receive, send)
            return
        self.open += 1
        try:
            await self.app(scope, receive, send)
        finally:
            self.open -= 1


@dataclass(frozen=True)
class Turns:
    """One limiter a kind; to be made where an event loop runs."""

    predictions: CapacityLimiter
    uploads: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(2))
    archives: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(1))


Made = TypeVar("Made")


async def in_turn(turns: CapacityLimiter, make: Callable[..., Made], *args: Any) -> Made:
    """Compute in a thread when it is this one's turn, which lasts until the thread is through.

    Who asks may go away, as a call of gRPC does at its deadline: then what waits is not computed, and what computes
    keeps its turn, so that no more is computed at a time than there are turns.
    """
    turn = object()
    await turns.acquire_on_behalf_of(turn)

    def over(done: asyncio.Future[Made]) -> None:
        turns.release_on_behalf_of(turn)
        if not done.cancelled():
            done.exception()  # else asyncio logs one that nobody waits for any more

    computing = asyncio.ensure_future(to_thread.run_sync(make, *args, limiter=CapacityLimiter(1)))
    computing.add_done_callback(over)
    return await asyncio.shield(computing)


COUNTED = "lipserve.counted"
"""In the ASGI scope of a request that was counted already: of a key with a rate of its own."""
FORGET_S = 1.0
"""Shortest time in s between two searches for clients that need not be remembered any more."""
NETWORK_BITS = 64
"""Leading bits of an IPv6 address that tell clients apart: who has one address has all that begin with them."""
OTHERS, LOCAL = "others", "a local socket"


class Rate:
    """A token bucket for each client: `burst` tokens at most, of which `per_s` are put in every second.

    Kept as one time per client, when its bucket will be full again. most: clients that have one of their
    own; the others share one.
    """

    def __init__(self, per_s: float, burst: int, most: int = 10_000) -> None:
        self.step, self.depth, self.most = 1 / per_s, burst / per_s, most
        self._full: dict[str, float] = {}
        self._forgotten = -FORGET_S

    def wait(self, client: str, at: float) -> float:
        """Take a token at a time in s; 0 where there was one, else the s until there will be."""
        full = self._full.get(client)
        if full is None and len(self._full) >= self.most:
            self._forget(at)
            if len(self._full) >= self.most:
                client = OTHERS
                full = self._full.get(client)
        then = (at if full is None or full < at else full) + self.step
        if then - at > self.depth * (1 + 1e-9):
            return then - at - self.depth
        self._full[client] = then
        return 0.0

    def _forget(self, at: float) -> None:
        """Forget those whose buckets are full: they are as good as new."""
        if at - self._forgotten >= FORGET_S:
            self._forgotten = at
            self._full = {client: full for client, full in self._full.items() if full > at}


class RateLimit:
    """Middleware that refuses the requests of a client beyond its rate. Inside the one that knows keys.

    A stream counts when it is opened, not its frames.
    """

    def __init__(self, app: ASGIApp, per_s: float, burst: int) -> None:
        self.app, self.per_s, self.rate = app, per_s, Rate(per_s, burst)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer it with 429."""
        if scope["type"] != "lifespan" and COUNTED not in scope and not scope["path"].startswith(HEALTH):
            client = client_of(scope)
            wait = self.rate.wait(client, monotonic())
            if wait:
                message = f"{client} asks more than {self.per_s:g} times per s (LIPSERVE_MAX_REQUESTS_PER_S)"
                error = RateLimitedError(message, headers={"Retry-After": str(ceil(wait))})
                await refuse(error, scope, receive, send)
                return
        await self.app(scope, receive, send)


def client_of(scope: Scope) -> str:
    """Who asks, in words: an API key, else an address or the network it is in, else a local socket."""
    key: str | None = scope.get(KEY_ID)
    if key is not None:
        return f"the API key {key}"
    client = scope.get("client")
    return network_of(client[0]) if client else LOCAL


def network_of(host: str) -> str:
    """An address, or of IPv6 the network that it is in, in words."""
    if ":" in host:
        try:
            address = ip_address(host.partition("%")[0])
        except ValueError:  # what a proxy says
            return host[:100]
        if isinstance(address, IPv6Address) and address.ipv4_mapped is None:
            host_bits = address.max_prefixlen - NETWORK_BITS
            return f"{IPv6Address(int(address) >> host_bits << host_bits)}/{NETWORK_BITS}"
        host = str(address.ipv4_mapped) if isinstance(address, IPv6Address) else host
    return host[:100] or LOCAL

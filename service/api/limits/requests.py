"""Limits of requests: their number, concurrent computations, and size and time of bodies."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from ipaddress import IPv6Address, ip_address
from time import monotonic
from typing import Any, TypeVar

from anyio import CapacityLimiter, to_thread
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.errors import refuse
from service.foundation.errors import BusyError
from service.foundation.settings import Settings
from service.models.archive_reading import MAX_ARCHIVE_BYTES, MAX_URDF_BYTES
from service.telemetry.counters import Gauge, new_gauge
from service.telemetry.logs import KEY_ID

MAX_REQUESTS = 256
"""Max requests at a time. A quarter as many may receive bodies from one client. Further ones are answered 429."""


@dataclass(frozen=True)
class ClientPatience:
    """How long the service waits for a slow client before it closes the connection."""

    header_s: float = 10.0
    """For the request line and headers."""
    header_bytes: int = 64 * 1024
    """Max size of the request line and headers."""
    body_s: float = 20.0
    """Max wait for a body, s, plus one second for every `body_bytes_per_s` received."""
    body_bytes_per_s: int = 1000
    answer_s: float = 30.0
    """Max wait until the client reads a part of its answer, s."""
    frame_s: float = 10.0
    """Max wait until the client reads an answer of a stream, s."""


PATIENCE = ClientPatience()


def body_limits(settings: Settings) -> dict[str, int]:
    """Return the max body size in bytes, by path or last part of a path; `*`: for every other path."""
    return {
        "/v1/datasets": settings.max_upload_bytes,
        "/v1/robots": MAX_URDF_BYTES,
        "/v1/models/import": MAX_ARCHIVE_BYTES,
        **dict.fromkeys(("predict", "observations", "infer", "ModelInfer", "echo"), settings.max_request_bytes),
        "*": min(256 * 1024, settings.max_request_bytes),  # a list of a thousand long names
    }


def body_limit(limits: Mapping[str, int], path: str) -> int:
    """Return the max body size of a path."""
    return limits.get(path) or limits.get(path.rpartition("/")[2]) or limits["*"]


WITHOUT_BODY = ("GET", "HEAD")
"""Methods of requests without a body; if there is one, it is ignored."""


class BodyLimit:
    """Middleware that rejects too large, too slow and too many request bodies.

    Args:
        app: The application.
        limits: Max sizes, see `body_limits`.
        seconds: Max wait for a body, plus one second for every `bytes_per_s` received. Only the wait for the client
            counts, not the application's work between two pieces.
        bytes_per_s: See `seconds`.
        at_once: Max bodies of one client that are received at a time; further ones are answered 429.

    FastAPI's `max_body_size` is not used, as it answers in plain text if the body's length is announced. A periodic
    check of all waits is used instead of one timer per request: a timer takes 2 µs, five times as long.
    """

    def __init__(
        self, app: ASGIApp, limits: Mapping[str, int], seconds: float, bytes_per_s: float, at_once: int
    ) -> None:
        self.app, self.limits = app, dict(limits)
        self.seconds, self.bytes_per_s, self.at_once = seconds, bytes_per_s, at_once
        self._waited_for: Counter[str] = Counter()  # number of bodies being received, by client
        self._due: dict[asyncio.Task[Any], float | None] = {}  # deadline of each wait; None: it was cancelled
        self._scheduled: asyncio.AbstractEventLoop | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on. Reading its body raises HTTPException with 413, 408 or 429."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        if scope["method"] in WITHOUT_BODY:
            await self.app(scope, _ignoring_body(receive), send)
            return
        limit = body_limit(self.limits, scope["path"])
        refused = False
        for name, value in scope["headers"]:
            if name == b"content-length":
                refused = value.isdigit() and (len(value) > 18 or int(value) > limit)
        client, seen, waited, complete = client_of(scope), 0, 0.0, False

        async def limited() -> Message:
            nonlocal seen, waited, complete
            if complete:  # a further call waits for the client to disconnect, without a limit
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
            if self._scheduled is not task.get_loop():
                self._schedule_check()
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
                # HTTPException: FastAPI would report any other exception as a parse error
                raise _too_large(limit)
            return message

        await self.app(scope, limited, send)

    def _schedule_check(self) -> None:
        self._scheduled = asyncio.get_running_loop()
        self._scheduled.call_later(min(0.5, self.seconds / 4), self._cancel_overdue)

    def _cancel_overdue(self) -> None:
        """Cancel the waits that are past their deadline."""
        now = monotonic()
        for task, due in self._due.items():
            if due is not None and due <= now:
                self._due[task] = None
                task.cancel()
        self._scheduled = None
        if self._due:
            self._schedule_check()


def _ignoring_body(receive: Receive) -> Receive:
    """Return a function that waits for the client to disconnect. An error would end an answer that has begun."""

    async def disconnected() -> Message:
        while (message := await receive())["type"] == "http.request":
            pass
        return message

    return disconnected


def _too_large(limit: int) -> HTTPException:
    return HTTPException(413, f"The body is too large: at most {limit} bytes are allowed.")


def _too_many(client: str, at_once: int) -> HTTPException:
    message = f"Too many request bodies from {client} at the same time: at most {at_once}."
    return HTTPException(429, message, {"Retry-After": "1", "Connection": "close"})


def _too_slow(seen: int) -> HTTPException:
    # close: the rest of the body must not be read as the next request
    return HTTPException(408, f"The body arrived too slowly: {seen} bytes so far.", {"Connection": "close"})


HEALTH = "/health"
"""Requests to this path and below are always answered, so that a busy service does not look dead."""


class Gate:
    """Middleware that limits the number of requests at a time. Streams have their own limit.

    admitted: the number of requests that are being answered.
    """

    def __init__(self, app: ASGIApp, max_requests: int, admitted: Gauge | None = None) -> None:
        self.app, self.max_requests, self.admitted = app, max_requests, new_gauge() if admitted is None else admitted

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on or answer 429."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        admitted = self.admitted.total
        if admitted >= self.max_requests:
            if scope["path"].startswith(HEALTH):
                await self.app(scope, receive, send)
                return
            message = f"The service is busy with {admitted} requests, the max. Try again later."
            await refuse(BusyError(message, headers={"Retry-After": "1"}), scope, receive, send)
            return
        self.admitted.add(1)
        try:
            await self.app(scope, receive, send)
        finally:
            self.admitted.add(-1)


@dataclass(frozen=True)
class Turns:
    """Limits of concurrent computations, by kind. Create it inside the event loop."""

    predictions: CapacityLimiter
    uploads: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(2))
    archives: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(1))


Made = TypeVar("Made")


async def in_turn(turns: CapacityLimiter, make: Callable[..., Made], *args: Any) -> Made:
    """Compute in a thread, waiting for one of the turns first and holding it until the thread ends.

    If the caller is cancelled, as a gRPC call at its deadline, a waiting computation is dropped. A running one keeps
    its turn, so that the limit holds.
    """
    turn = object()
    await turns.acquire_on_behalf_of(turn)

    def over(done: asyncio.Future[Made]) -> None:
        turns.release_on_behalf_of(turn)
        if not done.cancelled():
            done.exception()  # else asyncio logs it as never retrieved

    computing = asyncio.ensure_future(to_thread.run_sync(make, *args, limiter=CapacityLimiter(1)))
    computing.add_done_callback(over)
    return await asyncio.shield(computing)


COUNTED = "lipserve.counted"
"""Marks the ASGI scope of a request that was already counted: by its key's own rate, or by another process."""
NETWORK_BITS = 64
"""Leading bits of an IPv6 address that identify a client: a client can use all addresses with this prefix."""
LOCAL = "a local socket"


def client_of(scope: Scope) -> str:
    """Return a name for the client: its API key, else its address or network, else a local socket."""
    key: str | None = scope.get(KEY_ID)
    if key is not None:
        return f"API key {key}"
    client = scope.get("client")
    return network_of(client[0]) if client else LOCAL


def network_of(host: str) -> str:
    """Return an IPv4 address, or the network of an IPv6 address."""
    if ":" in host:
        try:
            address = ip_address(host.partition("%")[0])
        except ValueError:  # any text from a proxy
            return host[:100]
        if isinstance(address, IPv6Address) and address.ipv4_mapped is None:
            host_bits = address.max_prefixlen - NETWORK_BITS
            return f"{IPv6Address(int(address) >> host_bits << host_bits)}/{NETWORK_BITS}"
        host = str(address.ipv4_mapped) if isinstance(address, IPv6Address) else host
    return host[:100] or LOCAL

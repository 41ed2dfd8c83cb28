"""Serves gRPC in the event loop of the service, and passes calls to the application as requests."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import grpc
from starlette.types import ASGIApp, Message, Scope
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from service.api.errors import UNEXPECTED_ERROR
from service.api.limits.requests import COUNTED, MAX_REQUESTS, PATIENCE
from service.api.oip.rpc import port_error
from service.api.oip.rpc.definition import SERVICE
from service.api.oip.rpc.messages import PROTOBUF
from service.api.oip.rpc.methods import CALL, METHODS
from service.api.requests import HANDED_OVER
from service.api.server.sockets import DRAIN_S
from service.foundation.settings import Settings
from service.telemetry.readiness import StopState

logger = logging.getLogger(__name__)

_CODES = {
    400: grpc.StatusCode.INVALID_ARGUMENT,
    401: grpc.StatusCode.UNAUTHENTICATED,
    403: grpc.StatusCode.PERMISSION_DENIED,
    404: grpc.StatusCode.NOT_FOUND,
    408: grpc.StatusCode.DEADLINE_EXCEEDED,
    409: grpc.StatusCode.FAILED_PRECONDITION,
    413: grpc.StatusCode.RESOURCE_EXHAUSTED,
    415: grpc.StatusCode.INVALID_ARGUMENT,
    422: grpc.StatusCode.INVALID_ARGUMENT,
    429: grpc.StatusCode.RESOURCE_EXHAUSTED,
    503: grpc.StatusCode.UNAVAILABLE,
    507: grpc.StatusCode.RESOURCE_EXHAUSTED,
}
"""gRPC codes of HTTP statuses; INTERNAL for all others."""
_TRAILING = frozenset({b"x-request-id", b"retry-after", b"www-authenticate"})
"""Headers that are copied to the trailing metadata of a call."""
ERROR_CODE = "lipserve-error-code"
"""Key of the trailing metadata with the code of an error, such as `invalid_request`."""
CLIENT, COUNTED_CALL = "lipserve-client", "lipserve-counted"
"""Keys of the metadata of a forwarded call: its client, and one that is there if rate limits have counted the call."""


Forward = Callable[[str, bytes, Any, bool], Awaitable[bytes]]
"""Answers a call in another process: its path, message and context, and whether rate limits have counted it."""


@asynccontextmanager
async def listening(
    app: ASGIApp,
    settings: Settings,
    stopping: StopState,
    forwarded_to: Path | None = None,
    forward: Forward | None = None,
) -> AsyncIterator[int]:
    """Serve calls while the context is open and yield the port; raise PortError.

    When the service stops, new calls are rejected, and running calls have as much time to end as HTTP requests.

    forwarded_to: Unix-domain socket of calls that another process forwards, instead of a port; forward: answers the
    calls that the application hands over.
    """
    answer, proxied = _answer if forwarded_to is None else _answer_forwarded, _proxied(app, settings)
    handlers = {
        path.rpartition("/")[2]: grpc.stream_unary_rpc_method_handler(partial(answer, proxied, path, forward))
        for path in METHODS
    }
    server = grpc.aio.server(options=_options(settings))
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE, handlers),))
    host = f"[{settings.host}]" if ":" in settings.host else settings.host
    try:
        address = f"{host}:{settings.grpc_port}" if forwarded_to is None else f"unix:{forwarded_to}"
        port = server.add_insecure_port(address)
    except RuntimeError as error:
        raise port_error(settings, str(error)) from error
    await server.start()
    if forwarded_to is None:
        logger.info("gRPC on %s:%d", host, port)
    stop = asyncio.create_task(_stop(server, stopping))
    try:
        yield port
    finally:
        stop.cancel()
        await server.stop(DRAIN_S)


async def _stop(server: grpc.aio.Server, stopping: StopState) -> None:
    await stopping.closing.wait()
    await server.stop(DRAIN_S)


def _options(settings: Settings) -> list[tuple[str, int]]:
    """Return the limits of HTTP requests as options of gRPC, as far as there are such options."""
    return [
        ("grpc.so_reuseport", 0),  # else a second service at the port would get half of the calls
        ("grpc.max_receive_message_length", settings.max_request_bytes),
        ("grpc.max_send_message_length", -1),
        ("grpc.max_metadata_size", PATIENCE.header_bytes),
        ("grpc.absolute_max_metadata_size", PATIENCE.header_bytes),
        ("grpc.max_concurrent_streams", MAX_REQUESTS),
        ("grpc.max_allowed_incoming_connections", settings.max_connections),
        ("grpc.server_handshake_timeout_ms", int(PATIENCE.header_s * 1000)),
        ("grpc.max_connection_idle_ms", int(settings.stream_idle_s * 1000)),
        ("grpc.keepalive_time_ms", int(PATIENCE.answer_s * 1000)),  # detects vanished clients
        ("grpc.compression_enabled_algorithms_bitset", 1),  # only uncompressed messages
    ]


def _proxied(app: ASGIApp, settings: Settings) -> ASGIApp:
    """Wrap the application so that trusted reverse proxies can give the client's address."""
    made: Any = ProxyHeadersMiddleware(app, trusted_hosts=settings.trusted_proxies)  # type: ignore[arg-type]
    return made  # type: ignore[no-any-return]


async def _answer(app: ASGIApp, path: str, forward: Forward | None, _: Any, context: Any) -> bytes:
    """Answer a call of a client."""
    return await _ask(app, _scope(path, context, context.peer()), forward, context)


async def _answer_forwarded(app: ASGIApp, path: str, forward: Forward | None, _: Any, context: Any) -> bytes:
    """Answer a call that another process has forwarded, with its client."""
    given = dict(context.invocation_metadata() or ())
    scope = _scope(path, context, given.get(CLIENT, ""))
    if COUNTED_CALL in given:
        scope[COUNTED] = True
    return await _ask(app, scope, forward, context)


async def _ask(app: ASGIApp, scope: Scope, forward: Forward | None, context: Any) -> bytes:
    """Answer a call through the application, which reads the message under the limits of its middleware."""
    status, headers, parts, body = 500, list[tuple[bytes, bytes]](), list[bytes](), b""

    async def receive() -> Message:
        nonlocal body
        sent = await context.read()
        body = b"" if sent is grpc.aio.EOF else sent
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(answer: Message) -> None:
        nonlocal status, headers
        if answer["type"] == "http.response.start":
            status, headers = answer["status"], answer["headers"]
        else:
            parts.append(answer.get("body", b""))

    try:
        await app(scope, receive, send)
    except Exception:
        if not parts:  # else the application has logged and answered it
            logger.exception("unexpected error at %s", scope["path"])
    if forward is not None and HANDED_OVER in scope:
        return await forward(scope["path"], body, context, COUNTED in scope)
    trailing = tuple((name.decode(), value.decode("latin-1")) for name, value in headers if name in _TRAILING)
    if status == 200:
        context.set_trailing_metadata(trailing)
        return b"".join(parts)
    code, words = _error(b"".join(parts))
    await context.abort(_CODES.get(status, grpc.StatusCode.INTERNAL), words, (*trailing, (ERROR_CODE, code)))
    raise AssertionError("context.abort did not raise")


def _error(body: bytes) -> tuple[str, str]:
    """Return code and message of an error response."""
    error = json.loads(body)["error"] if body else {}
    return error.get("code", "internal_error"), error.get("message", UNEXPECTED_ERROR)


def _scope(path: str, context: Any, peer: str) -> Scope:
    return {
        "type": "http",
        "asgi": {"version": "3.0", "spec_version": "2.3"},
        "http_version": "2",
        "method": "POST",
        "scheme": "http",
        "path": path,
        "raw_path": path.encode(),
        "root_path": "",
        "query_string": b"",
        "headers": [(b"content-type", PROTOBUF), *_headers(context.invocation_metadata() or ())],
        "client": _client(peer),
        "server": None,
        "state": {},
        CALL: True,
    }


def _headers(metadata: Iterable[tuple[str, str | bytes]]) -> Iterator[tuple[bytes, bytes]]:
    """Yield the text metadata of a call as headers."""
    for name, value in metadata:
        if isinstance(value, str):
            yield name.lower().encode("latin-1"), value.encode("latin-1", "replace")


def _client(peer: str) -> tuple[str, int] | None:
    """Return address and port of a peer such as `ipv4:127.0.0.1:50000` or `ipv6:%5B::1%5D:50000`."""
    kind, _, address = unquote(peer).partition(":")
    host, _, port = address.rpartition(":")
    return (host.strip("[]"), int(port)) if kind in ("ipv4", "ipv6") and port.isdigit() else None

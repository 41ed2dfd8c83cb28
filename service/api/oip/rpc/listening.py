"""Listens for gRPC in the service's own event loop, and hands calls to the application as requests."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import AsyncIterator, Iterable, Iterator
from contextlib import asynccontextmanager
from functools import partial
from typing import Any
from urllib.parse import unquote

import grpc
from starlette.types import ASGIApp, Message, Scope
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from service.api.limits.requests import MAX_REQUESTS, PATIENCE
from service.api.oip.rpc import taken
from service.api.oip.rpc.definition import SERVICE
from service.api.oip.rpc.messages import PROTOBUF
from service.api.oip.rpc.methods import CALL, METHODS
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
"""What stands for a status of HTTP; INTERNAL for all others."""
_TRAILING = frozenset({b"x-request-id", b"retry-after", b"www-authenticate"})
"""Headers that a call's trailing metadata have, too."""
ERROR_CODE = "lipserve-error-code"
"""Trailing metadata with the code of an error, as `invalid_request`."""


@asynccontextmanager
async def listening(app: ASGIApp, settings: Settings, stopping: StopState) -> AsyncIterator[int]:
    """Take calls while the context lasts, and give the port. Where the service stops, no more are taken, and those
    begun have the time that requests have. Raise PortError."""
    handlers = {
        path.rpartition("/")[2]: grpc.stream_unary_rpc_method_handler(partial(_answer, _proxied(app, settings), path))
        for path in METHODS
    }
    server = grpc.aio.server(options=_options(settings))
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE, handlers),))
    host = f"[{settings.host}]" if ":" in settings.host else settings.host
    try:
        port = server.add_insecure_port(f"{host}:{settings.grpc_port}")
    except RuntimeError as error:
        raise taken(settings, str(error)) from error
    await server.start()
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
    """The limits that requests over HTTP have, where gRPC itself knows them."""
    return [
        ("grpc.so_reuseport", 0),  # else a second service would take half of the calls
        ("grpc.max_receive_message_length", settings.max_request_bytes),
        ("grpc.max_send_message_length", -1),
        ("grpc.max_metadata_size", PATIENCE.header_bytes),
        ("grpc.absolute_max_metadata_size", PATIENCE.header_bytes),
        ("grpc.max_concurrent_streams", MAX_REQUESTS),
        ("grpc.max_allowed_incoming_connections", settings.max_connections),
        ("grpc.server_handshake_timeout_ms", int(PATIENCE.header_s * 1000)),
        ("grpc.max_connection_idle_ms", int(settings.stream_idle_s * 1000)),
        ("grpc.keepalive_time_ms", int(PATIENCE.answer_s * 1000)),  # who has gone without a word
        ("grpc.compression_enabled_algorithms_bitset", 1),  # none: messages are taken uncompressed
    ]


def _proxied(app: ASGIApp, settings: Settings) -> ASGIApp:
    """The application as behind the reverse proxies that are trusted to say who asks."""
    made: Any = ProxyHeadersMiddleware(app, trusted_hosts=settings.trusted_proxies)  # type: ignore[arg-type]
    return made  # type: ignore[no-any-return]


async def _answer(app: ASGIApp, path: str, _: Any, context: Any) -> bytes:
    """Answer a call as the application answers a request. The message is read when the application asks for it, under
    its limits."""
    status, headers, parts = 500, list[tuple[bytes, bytes]](), list[bytes]()

    async def receive() -> Message:
        sent = await context.read()
        return {"type": "http.request", "body": b"" if sent is grpc.aio.EOF else sent, "more_body": False}

    async def send(answer: Message) -> None:
        nonlocal status, headers
        if answer["type"] == "http.response.start":
            status, headers = answer["status"], answer["headers"]
        else:
            parts.append(answer.get("body", b""))

    try:
        await app(_scope(path, context), receive, send)
    except Exception:
        if not parts:  # else the application has logged and answered it
            logger.exception("unexpected error at %s", path)
    trailing = tuple((name.decode(), value.decode("latin-1")) for name, value in headers if name in _TRAILING)
    if status == 200:
        context.set_trailing_metadata(trailing)
        return b"".join(parts)
    code, words = _error(b"".join(parts))
    await context.abort(_CODES.get(status, grpc.StatusCode.INTERNAL), words, (*trailing, (ERROR_CODE, code)))
    raise AssertionError("abort has raised")


def _error(body: bytes) -> tuple[str, str]:
    """Code and words of an error that the application has answered."""
    error = json.loads(body)["error"] if body else {}
    return error.get("code", "internal_error"), error.get("message", "an unexpected error; the service's log says more")


def _scope(path: str, context: Any) -> Scope:
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
        "client": _client(context.peer()),
        "server": None,
        "state": {},
        CALL: True,
    }


def _headers(metadata: Iterable[tuple[str, str | bytes]]) -> Iterator[tuple[bytes, bytes]]:
    """A call's metadata as headers, besides the binary ones."""
    for name, value in metadata:
        if isinstance(value, str):
            yield name.lower().encode("latin-1"), value.encode("latin-1", "replace")


def _client(peer: str) -> tuple[str, int] | None:
    """Address and port of a peer, as `ipv4:127.0.0.1:50000` or `ipv6:%5B::1%5D:50000`."""
    kind, _, address = unquote(peer).partition(":")
    host, _, port = address.rpartition(":")
    return (host.strip("[]"), int(port)) if kind in ("ipv4", "ipv6") and port.isdigit() else None

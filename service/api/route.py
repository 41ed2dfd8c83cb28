"""Route classes: common checks of every request, and routes that bypass FastAPI.

FastAPI's validation and dependencies take 0.3 ms per request.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from typing import Any, NamedTuple, TypeVar
from urllib.parse import parse_qsl

from fastapi import Request, Response
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute
from pydantic import BaseModel
from starlette.requests import ClientDisconnect
from starlette.types import Message, Receive, Scope, Send

from service.foundation.errors import UnsupportedMediaTypeError, invalid_request, problem, readable, sentence
from service.foundation.json_text import read_json

T = TypeVar("T")
JSON, OCTETS = b"application/json", b"application/octet-stream"
_ANY_JSON = re.compile(rb"application/([^;/]+\+)?json\s*(;.*)?", re.IGNORECASE | re.DOTALL)
MAX_QUERY_PARAMETERS = 100
"""Max number of query parameters."""


class Route(APIRoute):
    """A route that rejects unknown and repeated query parameters, and ambiguous JSON."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return the handler, which checks a request first."""
        handle, parameters = super().get_route_handler(), tuple(_parameters(self.dependant))
        body = self.body_field is not None

        async def checked(request: Request) -> Response:
            check_query(request.scope, parameters)
            _check_encoding(request.scope)
            return await handle(await _JsonRequest.read(request) if body else request)

        return checked


def check_query(scope: Scope, known: tuple[str, ...] = ()) -> None:
    """Raise InvalidRequestError for an unknown or repeated query parameter."""
    if not scope["query_string"]:
        return
    try:
        given = parse_qsl(scope["query_string"].decode("latin-1"), True, max_num_fields=MAX_QUERY_PARAMETERS)
    except ValueError:
        expected = f"at most {MAX_QUERY_PARAMETERS} parameters"
        raise invalid_request(
            "query", "too long", expected, f"Too many query parameters, expected {expected}."
        ) from None
    seen = set()
    for name, value in given:
        if name not in known:
            expected = f"one of the parameters {', '.join(known)}" if known else "no query parameters"
            message = f"Unknown query parameter `{readable(name[:200])}`, expected {expected}."
            raise invalid_request(name or "query", value, expected, message)
        if name in seen:
            message = f"Query parameter `{readable(name[:200])}` is given twice."
            raise invalid_request(name, "given twice", "each parameter once", message)
        seen.add(name)


def media_type(scope: Scope) -> bytes:
    """Return the content-type of a request, empty if it has none."""
    return next((value for name, value in scope["headers"] if name == b"content-type"), b"")


def is_json(scope: Scope) -> bool:
    """Return whether the content-type is `application/json`, with or without parameters."""
    given = media_type(scope)
    return given == JSON or given.partition(b";")[0].strip().lower() == JSON


class _JsonRequest(Request):
    """A request with its JSON already parsed."""

    _value: Any

    @classmethod
    async def read(cls, request: Request) -> Request:
        """Read and parse the body, if there is one; raise UnsupportedMediaTypeError or InvalidRequestError."""
        read = cls(request.scope, request.receive)
        if body := await read.body():
            if not _ANY_JSON.fullmatch(media_type(request.scope)):
                item = problem("content-type", media_type(request.scope).decode("latin-1"), JSON.decode())
                raise UnsupportedMediaTypeError(sentence(item), [item])
            read._value = read_json(body)
        return read

    async def json(self) -> Any:
        """Return the parsed body."""
        return self._value


def _check_encoding(scope: Scope) -> None:
    given = next((value for name, value in scope["headers"] if name == b"content-encoding"), b"identity")
    if given.lower() != b"identity":
        item = problem("Content-Encoding", given.decode("latin-1"), "an uncompressed body")
        raise UnsupportedMediaTypeError(sentence(item), [item])


def _parameters(dependant: Dependant) -> Iterator[str]:
    for parameter in dependant.query_params:
        annotation = parameter.field_info.annotation
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            yield from annotation.model_fields
        else:
            yield parameter.alias
    for below in dependant.dependencies:
        yield from _parameters(below)


class Reply(NamedTuple):
    """An answer with status 200; `more`: further headers, with names in lower case."""

    body: bytes
    media_type: bytes = JSON
    more: tuple[tuple[bytes, bytes], ...] = ()

    def headers(self) -> list[tuple[bytes, bytes]]:
        """Return all headers of the answer."""
        return [
            (b"content-length", b"%d" % len(self.body)),
            (b"content-type", self.media_type),
            (b"x-content-type-options", b"nosniff"),
            *self.more,
        ]

    def response(self) -> Response:
        """Return the answer as a response for FastAPI."""
        made = Response(self.body)
        made.raw_headers = self.headers()
        return made


Answerer = Callable[[Scope, bytes], Awaitable[Reply | None]]
"""Answers a request from its scope and body; returns None to leave it to the endpoint. Its errors are answered."""
PatientAnswerer = Callable[[Scope, bytes], Awaitable[Reply | Awaitable[Reply | None] | None]]
"""The same, or returns a coroutine that answers. It is cancelled if the client disconnects."""


def hot_route(answer: PatientAnswerer) -> type[Route]:
    """Return a route class that passes POST requests to `answer` first, bypassing FastAPI.

    If `answer` returns None, the endpoint handles the request as usual. So `answer` only needs to handle correct
    requests; the endpoint explains wrong ones, and its signature documents the route.
    """

    class HotRoute(Route):
        async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
            if scope["method"] != "POST":
                await super().handle(scope, receive, send)
                return
            check_query(scope)
            body = await _read(receive)
            if body is None:  # the client disconnected
                return
            reply = await answer(scope, body)
            if reply is not None and not isinstance(reply, Reply):
                try:
                    reply = await unless_disconnected(receive, reply)
                except ClientDisconnect:
                    return
            if reply is None:
                await super().handle(scope, _again(body, receive), send)
                return
            await send({"type": "http.response.start", "status": 200, "headers": reply.headers()})
            await send({"type": "http.response.body", "body": reply.body})

    return HotRoute


async def unless_disconnected(receive: Receive, computing: Awaitable[T]) -> T:
    """Return the result of a coroutine; cancel it and raise ClientDisconnect if the client disconnects before."""
    result, leaving = asyncio.ensure_future(computing), asyncio.ensure_future(_disconnection(receive))
    try:
        await asyncio.wait({result, leaving}, return_when=asyncio.FIRST_COMPLETED)
        if not result.done():
            raise ClientDisconnect
        return result.result()
    finally:
        result.cancel()
        leaving.cancel()


async def _disconnection(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass


async def _read(receive: Receive) -> bytes | None:
    message = await receive()
    if not message.get("more_body") and message["type"] == "http.request":
        body: bytes = message.get("body", b"")
        return body
    parts: list[bytes] = []
    while message["type"] == "http.request":
        parts.append(message.get("body", b""))
        if not message.get("more_body"):
            return b"".join(parts)
        message = await receive()
    return None


def _again(body: bytes, receive: Receive) -> Receive:
    """Return a `receive` that repeats a body that was already read, then continues with the original."""
    pending: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def replay() -> Message:
        return pending.pop() if pending else await receive()

    return replay

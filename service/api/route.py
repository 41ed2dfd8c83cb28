"""What every route refuses in the same way, before its endpoint sees the request; and routes that are answered before
FastAPI looks at the request: its validation and dependencies cost 0.3 ms."""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from typing import Any, NamedTuple
from urllib.parse import parse_qsl

from fastapi import Request, Response
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute
from pydantic import BaseModel
from starlette.types import Message, Receive, Scope, Send

from service.foundation.errors import UnsupportedMediaTypeError, invalid_request, problem, sentence
from service.foundation.json_text import read_json

JSON, OCTETS = b"application/json", b"application/octet-stream"
_ANY_JSON = re.compile(rb"application/([^;/]+\+)?json\s*(;.*)?", re.IGNORECASE | re.DOTALL)
MOST_PARAMETERS = 100
"""Query parameters that are read at all."""


class Route(APIRoute):
    """A route that takes no query parameter it does not know or that comes twice, and no JSON that is ambiguous."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The handler of a request that has been found in order."""
        handle, parameters = super().get_route_handler(), tuple(_parameters(self.dependant))
        body = self.body_field is not None

        async def checked(request: Request) -> Response:
            check_query(request.scope, parameters)
            _check_encoding(request.scope)
            return await handle(await _JsonRequest.read(request) if body else request)

        return checked


def check_query(scope: Scope, known: tuple[str, ...] = ()) -> None:
    """Raise InvalidRequestError for a query parameter that is not among those known, or that is given twice."""
    if not scope["query_string"]:
        return
    try:
        given = parse_qsl(scope["query_string"].decode("latin-1"), True, max_num_fields=MOST_PARAMETERS)
    except ValueError:
        raise invalid_request("query", "too long", f"at most {MOST_PARAMETERS} parameters") from None
    seen = set()
    for name, value in given:
        if name not in known:
            expected = f"one of the parameters {', '.join(known)}" if known else "no query parameters"
            raise invalid_request(name or "query", value, expected)
        if name in seen:
            raise invalid_request(name, "given twice", "each parameter once")
        seen.add(name)


def media_type(scope: Scope) -> bytes:
    """The content-type of a request, empty where none is given."""
    return next((value for name, value in scope["headers"] if name == b"content-type"), b"")


def is_json(scope: Scope) -> bool:
    """Whether the body is announced as JSON, in one of the usual ways."""
    given = media_type(scope)
    return given == JSON or given.partition(b";")[0].strip().lower() == JSON


class _JsonRequest(Request):
    """A request whose JSON has been read."""

    _value: Any

    @classmethod
    async def read(cls, request: Request) -> Request:
        """Read the body of a request; raise UnsupportedMediaTypeError or InvalidRequestError, unless it is empty."""
        read = cls(request.scope, request.receive)
        if body := await read.body():
            if not _ANY_JSON.fullmatch(media_type(request.scope)):
                item = problem("content-type", media_type(request.scope).decode("latin-1"), JSON.decode())
                raise UnsupportedMediaTypeError(sentence(item), [item])
            read._value = read_json(body)
        return read

    async def json(self) -> Any:
        """The value that the body stands for."""
        return self._value


def _check_encoding(scope: Scope) -> None:
    given = next((value for name, value in scope["headers"] if name == b"content-encoding"), b"identity")
    if given.lower() != b"identity":
        item = problem("Content-Encoding", given.decode("latin-1"), "none: bodies are taken uncompressed")
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
    """An answer of status 200. more: headers beside the usual ones, their names in lower case."""

    body: bytes
    media_type: bytes = JSON
    more: tuple[tuple[bytes, bytes], ...] = ()

    def headers(self) -> list[tuple[bytes, bytes]]:
        """All headers of the answer."""
        return [
            (b"content-length", b"%d" % len(self.body)),
            (b"content-type", self.media_type),
            (b"x-content-type-options", b"nosniff"),
            *self.more,
        ]

    def response(self) -> Response:
        """Return the same answer for FastAPI to send."""
        made = Response(self.body)
        made.raw_headers = self.headers()
        return made


Answerer = Callable[[Scope, bytes], Awaitable[Reply | None]]
"""Answers a request from its scope and body, or None where it is not as usual; an error it raises is the answer."""


def hot_route(answer: Answerer) -> type[Route]:
    """Make a route class whose POST requests `answer` sees first.

    What it does not answer goes on to the endpoint as if it had not been seen. So the endpoint is what explains a
    wrong request, and its signature is what documents the route; `answer` only has to know a right one.
    """

    class HotRoute(Route):
        async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
            if scope["method"] != "POST":
                await super().handle(scope, receive, send)
                return
            check_query(scope)
            body = await _read(receive)
            if body is None:  # the client went away
                return
            reply = await answer(scope, body)
            if reply is None:
                await super().handle(scope, _again(body, receive), send)
                return
            await send({"type": "http.response.start", "status": 200, "headers": reply.headers()})
            await send({"type": "http.response.body", "body": reply.body})

    return HotRoute


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
    """Receive a body that has been read before, then what comes after it."""
    pending: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def replay() -> Message:
        return pending.pop() if pending else await receive()

    return replay

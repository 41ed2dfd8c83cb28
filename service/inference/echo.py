"""The echo: what a request costs before anything is computed."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request, Response
from starlette.types import Scope

from service.foundation.errors import TooLargeError, responses
from service.web.route import OCTETS, Reply, hot_route, media_type

_CONTENT: dict[str, Any] = {
    "application/json": {"schema": {}, "example": {"q": [0.0, -0.5], "dq": [0.1, 0.0], "ddq": [0.0, 0.5]}},
    "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
}
_DOCUMENTED: dict[str, Any] = {
    "requestBody": {"required": True, "content": _CONTENT},
    "responses": {"200": {"description": "The body as it came", "content": _CONTENT}},
}

hot = APIRouter(tags=["inference"], responses=responses(TooLargeError))


async def _answer(scope: Scope, body: bytes) -> Reply | None:
    given = media_type(scope)
    return Reply(body, given) if given else None


async def echo(request: Request) -> Response:
    """Answer the body as it came, with its media type, on the way that a query takes, limits and all.

    What a query takes longer is what the service computes; what the echo takes is HTTP, and the measuring client.
    """
    return Reply(await request.body(), OCTETS).response()  # with a media type, it has been answered before


hot.add_api_route(
    "/v1/echo",
    echo,
    methods=["POST"],
    summary="Answer what was sent: the floor of latency benchmarks",
    response_class=Response,
    openapi_extra=_DOCUMENTED,
    route_class_override=hot_route(_answer),
)

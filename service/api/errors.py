"""Error responses: {"error": {code, message, detail}} for every route, and {"error": message} below /v2."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.routing import iter_route_contexts
from sqlalchemy.exc import DBAPIError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import Receive, Scope, Send

from lipcore.extras import MissingExtraError
from service.foundation.errors import (
    ErrorBody,
    ErrorResponse,
    Problem,
    ServiceError,
    StorageUnavailableError,
    invalid_request,
    not_installed,
    problem,
    readable,
    sentence,
)
from service.storage import errors as storage_errors

logger = logging.getLogger(__name__)

OPEN_INFERENCE = "/v2"
"""Prefix of the Open Inference Protocol, which has its own form of errors."""
ERROR_CODE = "lipserve.error_code"
"""Key of the error code in the ASGI scope of a failed request, for metrics and logs."""
UNEXPECTED_ERROR = "Unexpected error. See the service's log for details."
"""Message of `internal_error`."""


def responses(*errors: type[ServiceError]) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI responses of a route for the errors that it can answer with."""
    out: dict[int | str, dict[str, Any]] = {}
    for error in errors:
        meaning = (error.__doc__ or "").strip()
        known = out.get(error.status)
        text = f"`{error.code}`: {meaning}"
        out[error.status] = {"model": ErrorResponse, "description": f"{known['description']} {text}" if known else text}
    return out


def install(app: FastAPI) -> None:
    """Install the error handlers in an application."""
    app.add_exception_handler(ServiceError, _service_error)
    app.add_exception_handler(MissingExtraError, _missing_extra)
    app.add_exception_handler(RequestValidationError, _validation_error)
    app.add_exception_handler(HTTPException, http_error)
    app.add_exception_handler(ClientDisconnect, _cut_off)
    for kind in (DBAPIError, PoolTimeoutError, OSError):
        app.add_exception_handler(kind, _storage_error)
    app.add_exception_handler(Exception, unexpected_error)


def answer_of(scope: Scope, error: ServiceError) -> JSONResponse:
    """Return the response for an error."""
    answer = _answer(scope, error.status, error.code, error.message, error.detail)
    answer.headers.update(error.headers)
    return answer


async def refuse(error: ServiceError, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer an HTTP or WebSocket request with an error. Middleware needs it: no handler sees its exceptions."""
    answer = answer_of(scope, error)
    if scope["type"] == "websocket":
        await receive()  # the request to connect
    # works for both protocols if the server supports WebSocket denial responses
    await answer(scope, receive, send)


def _answer(scope: Scope, status: int, code: str, message: str, detail: Sequence[Problem] = ()) -> JSONResponse:
    scope[ERROR_CODE] = code
    if f"{scope['path']}/".startswith(f"{OPEN_INFERENCE}/"):
        return JSONResponse({"error": message}, 400 if status == 422 else status)
    body = ErrorResponse(error=ErrorBody(code=code, message=message, detail=list(detail)))
    return JSONResponse(body.model_dump(), status)


async def _service_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, ServiceError)
    return answer_of(request.scope, error)


async def _missing_extra(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, MissingExtraError)
    return answer_of(request.scope, not_installed(error))


async def _validation_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    detail = [_explain(item) for item in error.errors()[:20]]
    message = sentence(detail[0]) if detail else "The request is not valid."
    return _answer(request.scope, 422, "invalid_request", message, detail)


def _explain(item: dict[str, Any]) -> Problem:
    where = [part for part in item["loc"] if part not in ("body", "query", "path", "header")]
    field = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in where).lstrip(".") or "body"
    kind, value, message = item["type"], item.get("input"), str(item["msg"])
    if kind == "json_invalid":
        return problem("body", f"not JSON at character {where[0]}: {item['ctx']['error']}", "JSON")
    if isinstance(value, bytes):
        return problem("body", value, "JSON, with the content-type application/json")
    if kind == "missing":
        return problem(field, "missing", "a value", f"`{field}` is required.")
    if kind == "extra_forbidden":
        return problem(field, value, "a known field", f"Unknown field `{readable(field[:200])}`.")
    return problem(field, value, message.removeprefix("Input should be ").replace("String should", "to", 1))


async def _cut_off(request: Request, error: Exception) -> JSONResponse:
    """Answer a client that disconnected while it sent its body; else it counts as a failure of the service."""
    return answer_of(request.scope, invalid_request("body", "incomplete", "the whole body"))


async def http_error(request: Request, error: Exception) -> JSONResponse:
    """Answer an error of a framework or of a middleware, in the service's words."""
    assert isinstance(error, HTTPException)
    codes = {404: "not_found", 405: "method_not_allowed", 408: "request_timeout", 413: "too_large", 429: "busy"}
    message = str(error.detail)
    if error.status_code in (404, 405):
        message = f"There is no route {request.method} {readable(request.url.path[:200])}. /docs lists all routes."
    answer = _answer(request.scope, error.status_code, codes.get(error.status_code, "http_error"), message)
    answer.headers.update(error.headers or {})
    # Starlette only lists the methods of one route, but several have the same path; it is right for mounted folders
    if error.status_code == 405 and (methods := _methods(request)):
        answer.headers["allow"] = ", ".join(methods)
    return answer


def _methods(request: Request) -> list[str]:
    """Return the allowed methods at the path of a request."""
    allowed: set[str] = set()
    for route in iter_route_contexts(request.app.routes):
        pattern, methods = getattr(route, "path_regex", None), getattr(route, "methods", None)
        if pattern is not None and methods and pattern.match(request.scope["path"]):
            allowed.update(methods)
    return sorted(allowed | {"HEAD"} if "GET" in allowed else allowed)


async def _storage_error(request: Request, error: Exception) -> JSONResponse:
    answer = storage_errors.translate_error(error)
    if answer is None and isinstance(error, FileNotFoundError) and not request.app.state.storage.files.in_place():
        answer = StorageUnavailableError("Files cannot be read or written: the home folder of the service is missing.")
    if answer is None:
        raise error  # an unexpected error
    logger.error("%s at %s: %s", answer.code, request.scope["path"], error)
    return answer_of(request.scope, answer)


async def unexpected_error(request: Request, error: Exception) -> JSONResponse:
    """Answer an unexpected exception, and log it with its traceback."""
    if request.scope.get(ERROR_CODE) != "internal_error":  # else already answered: the exception is raised again
        logger.error("unexpected error at %s %s", request.method, request.url.path, exc_info=error)
    return _answer(request.scope, 500, "internal_error", UNEXPECTED_ERROR)

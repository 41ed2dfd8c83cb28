"""One shape for the errors of every route, {"error": {code, message, detail}}; below /v2 it is {"error": message}."""

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
"""Routes below it speak the Open Inference Protocol, whose errors have a shape of their own."""
ERROR_CODE = "lipserve.error_code"
"""Key of the code in the ASGI scope of a request that ended in an error: for metrics and logs."""


def responses(*errors: type[ServiceError]) -> dict[int | str, dict[str, Any]]:
    """OpenAPI responses of a route for the errors it can answer with."""
    out: dict[int | str, dict[str, Any]] = {}
    for error in errors:
        meaning = (error.__doc__ or "").strip()
        known = out.get(error.status)
        text = f"`{error.code}`: {meaning}"
        out[error.status] = {"model": ErrorResponse, "description": f"{known['description']} {text}" if known else text}
    return out


def install(app: FastAPI) -> None:
    """Make every error of the app take the one shape."""
    app.add_exception_handler(ServiceError, _service_error)
    app.add_exception_handler(MissingExtraError, _missing_extra)
    app.add_exception_handler(RequestValidationError, _validation_error)
    app.add_exception_handler(HTTPException, _http_error)
    app.add_exception_handler(ClientDisconnect, _cut_off)
    for kind in (DBAPIError, PoolTimeoutError, OSError):
        app.add_exception_handler(kind, _storage_error)
    app.add_exception_handler(Exception, _unexpected_error)


def answer_of(scope: Scope, error: ServiceError) -> JSONResponse:
    """The answer to a request that ends in an error."""
    answer = _answer(scope, error.status, error.code, error.message, error.detail)
    answer.headers.update(error.headers)
    return answer


async def refuse(error: ServiceError, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer a request, or one for a WebSocket, with an error: for middleware, whose exceptions nobody handles."""
    answer = answer_of(scope, error)
    if scope["type"] == "websocket":
        await receive()  # the request to connect
    # Starlette sends what is right for either, as long as the server takes denials of WebSockets in HTTP
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
    message = sentence(detail[0]) if detail else "the request is not valid"
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
        return problem(field, "missing", "a value")
    if kind == "extra_forbidden":
        return problem(field, value, "no field of that name")
    return problem(field, value, message.removeprefix("Input should be ").replace("String should", "to", 1))


async def _cut_off(request: Request, error: Exception) -> JSONResponse:
    """The client went away before its body was there: nobody reads this, but it is no failure of the service."""
    return answer_of(request.scope, invalid_request("body", "cut off", "the whole of it"))


async def _http_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    codes = {404: "not_found", 405: "method_not_allowed", 408: "request_timeout", 413: "too_large", 429: "busy"}
    message = str(error.detail)
    if error.status_code in (404, 405):
        message = f"no route {request.method} {readable(request.url.path[:200])}: /docs lists all"
    answer = _answer(request.scope, error.status_code, codes.get(error.status_code, "http_error"), message)
    answer.headers.update(error.headers or {})
    # Starlette names the methods of one route, but others have the same path; it knows those of a folder
    if error.status_code == 405 and (methods := _methods(request)):
        answer.headers["allow"] = ", ".join(methods)
    return answer


def _methods(request: Request) -> list[str]:
    """What may be asked for at the path of a request."""
    allowed: set[str] = set()
    for route in iter_route_contexts(request.app.routes):
        pattern, methods = getattr(route, "path_regex", None), getattr(route, "methods", None)
        if pattern is not None and methods and pattern.match(request.scope["path"]):
            allowed.update(methods)
    return sorted(allowed)


async def _storage_error(request: Request, error: Exception) -> JSONResponse:
    answer = storage_errors.translate_error(error)
    if answer is None and isinstance(error, FileNotFoundError) and not request.app.state.storage.files.in_place():
        answer = StorageUnavailableError("files cannot be read or written now: the home of the service is gone")
    if answer is None:
        raise error  # as unexpected as any other
    logger.error("%s at %s: %s", answer.code, request.scope["path"], error)
    return answer_of(request.scope, answer)


async def _unexpected_error(request: Request, error: Exception) -> JSONResponse:
    if request.scope.get(ERROR_CODE) != "internal_error":  # else answered before, and seen again on its way out
        logger.error("unexpected error at %s %s", request.method, request.url.path, exc_info=error)
    return _answer(request.scope, 500, "internal_error", "an unexpected error; the service's log says more")

"""One error shape for every route, {"error": {code, message, detail}}; below /v2 it is {"error": message}."""

from __future__ import annotations

import logging
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.routing import iter_route_contexts
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import Receive, Scope, Send

from lipcore.extras import MissingExtraError, install_line

logger = logging.getLogger(__name__)

OPEN_INFERENCE = "/v2"
"""Routes below it speak the Open Inference Protocol, whose errors have a shape of their own."""
ERROR_CODE = "lipserve.error_code"
"""Key of the code in the ASGI scope of a request that ended in an error: for metrics and logs."""


_REPR = reprlib.Repr()  # Python's own takes as long as the value is large, and fails where it is nested deep
_REPR.maxlevel = 10
_REPR.maxlist = _REPR.maxtuple = _REPR.maxdict = _REPR.maxset = 200
_REPR.maxstring = _REPR.maxlong = _REPR.maxother = 1000


class Problem(BaseModel):
    """One thing that is wrong with a request."""

    field: str = Field(description="Where: a column, a JSON path or a parameter", examples=["q[0][3]"])
    value: str | None = Field(default=None, description="What was found", examples=["nan"])
    expected: str = Field(description="What was expected", examples=["a finite number"])


class ErrorBody(BaseModel):
    """code: stable, for programs; message: for people."""

    code: str = Field(examples=["invalid_request"])
    message: str = Field(examples=["q[0][3] is nan, expected a finite number"])
    detail: list[Problem] = []


class ErrorResponse(BaseModel):
    """The body of every answer with a status of 400 and above."""

    error: ErrorBody


class ServiceError(Exception):
    """An error a client can act on; subclasses fix status and code."""

    status = 500
    code = "internal_error"

    def __init__(self, message: str, detail: Sequence[Problem] = (), headers: Mapping[str, str] | None = None) -> None:
        super().__init__(message)
        self.message, self.detail, self.headers = message, list(detail), dict(headers or {})


class InvalidRequestError(ServiceError):
    """The request is understood, but a value in it is wrong."""

    status, code = 422, "invalid_request"


class InvalidDataError(ServiceError):
    """An uploaded data set is wrong."""

    status, code = 422, "invalid_data"


class NotFoundError(ServiceError):
    """No data set, job, model or version of that name."""

    status, code = 404, "not_found"


class ConflictError(ServiceError):
    """The request contradicts the state of things."""

    status, code = 409, "conflict"


class NoServingVersionError(ServiceError):
    """All versions of the model wait as candidates: none answers by itself."""

    status, code = 409, "no_serving_version"


class TooLargeError(ServiceError):
    """The body exceeds a limit."""

    status, code = 413, "too_large"


class UnsupportedMediaTypeError(ServiceError):
    """The body's media type is not one of those accepted."""

    status, code = 415, "unsupported_media_type"


class UnauthorizedError(ServiceError):
    """No API key was given where one is needed, or one that is not known, has expired or was revoked."""

    status, code = 401, "unauthorized"


class ForbiddenError(ServiceError):
    """The API key may not do this, or a web page of another site asks."""

    status, code = 403, "forbidden"


class RequestTimeoutError(ServiceError):
    """The body came too slowly."""

    status, code = 408, "request_timeout"


class BusyError(ServiceError):
    """A queue is full: try again later."""

    status, code = 429, "busy"


class RateLimitedError(ServiceError):
    """More requests than allowed in so short a time; the header `Retry-After` says when to go on."""

    status, code = 429, "rate_limited"


class NotReadyError(ServiceError):
    """The service cannot answer now."""

    status, code = 503, "not_ready"


class RevisionNotReachedError(ServiceError):
    """The version that answers has not learnt as much yet as the query asks for: the header `Retry-After` says when to
    ask again. Revisions count for one version: `version` names the one that an acknowledgement spoke of."""

    status, code = 503, "revision_not_reached"


class StorageUnavailableError(ServiceError):
    """The database or the disk cannot be written now: nothing was stored, try again."""

    status, code = 503, "storage_unavailable"


class StorageFullError(ServiceError):
    """The disk or the quota of the service is full: nothing was stored. Delete data sets or versions."""

    status, code = 507, "storage_full"


class NotInstalledError(ServiceError):
    """The service runs without the packages that this needs: `detail` names the extra and the line that installs it,
    where the service runs. `GET /health` says what it can do."""

    status, code = 501, "not_installed"


class DamagedDataError(ServiceError):
    """A stored data set does not have the checksum that it was stored with."""

    status, code = 500, "damaged_data"


class UnreadableVersionError(ServiceError):
    """The version's files are damaged, or of a format that this release does not read."""

    status, code = 500, "unreadable_version"


def problem(field: str, value: object, expected: str) -> Problem:
    """Describe one wrong value; long values are cut, and what is nested deep."""
    text = value if isinstance(value, str) else _REPR.repr(value)
    text = text if len(text) <= 200 else text[:200] + "…"
    return Problem(field=readable(field[:200]), value=readable(text), expected=expected)


def readable(text: str) -> str:
    """Escape what a terminal or a log would not show as it is: control and bidirectional characters, half ones."""
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)


def sentence(item: Problem) -> str:
    """Say a problem in one sentence."""
    return f"{item.field} is {item.value}, expected {item.expected}"


def invalid_request(field: str, value: object, expected: str) -> InvalidRequestError:
    """Error for one wrong value of a request."""
    item = problem(field, value, expected)
    return InvalidRequestError(sentence(item), [item])


def invalid_data(field: str, value: object, expected: str) -> InvalidDataError:
    """Error for one wrong thing in an uploaded data set."""
    item = problem(field, value, expected)
    return InvalidDataError(sentence(item), [item])


def not_installed(error: MissingExtraError) -> NotInstalledError:
    """Error for an extra that is not installed."""
    return NotInstalledError(str(error), [problem("extra", error.extra, install_line(error.extra))])


def not_found(kind: str, name: object) -> NotFoundError:
    """Error for something that does not exist."""
    return NotFoundError(f"no {kind} {str(name)[:200]!r}", [problem(kind, str(name), f"an existing {kind}")])


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
    if error.status_code == 405:  # Starlette names the methods of one route, but others have the same path
        answer.headers["allow"] = ", ".join(_methods(request))
    return answer


def _methods(request: Request) -> list[str]:
    """What may be asked for at the path of a request."""
    allowed: set[str] = set()
    for route in iter_route_contexts(request.app.routes):
        pattern, methods = getattr(route, "path_regex", None), getattr(route, "methods", None)
        if pattern is not None and methods and pattern.match(request.scope["path"]):
            allowed.update(methods)
    return sorted(allowed)


async def _unexpected_error(request: Request, error: Exception) -> JSONResponse:
    if request.scope.get(ERROR_CODE) != "internal_error":  # else answered before, and seen again on its way out
        logger.error("unexpected error at %s %s", request.method, request.url.path, exc_info=error)
    return _answer(request.scope, 500, "internal_error", "an unexpected error; the service's log says more")

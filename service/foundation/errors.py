"""The errors of the service with their status and code, and the body of an error response."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping, Sequence

from pydantic import BaseModel, Field

from lipcore.extras import MissingExtraError, install_line

_REPR = reprlib.Repr()  # Python's own takes longer for large values and fails on deeply nested ones
_REPR.maxlevel = 10
_REPR.maxlist = _REPR.maxtuple = _REPR.maxdict = _REPR.maxset = 200
_REPR.maxstring = _REPR.maxlong = _REPR.maxother = 1000


class Problem(BaseModel):
    """One thing that is wrong with a request."""

    field: str = Field(description="Where: a column, a JSON path or a parameter", examples=["q[0][3]"])
    value: str | None = Field(default=None, description="What was found", examples=["nan"])
    expected: str = Field(description="What was expected", examples=["a finite number"])
    _message: str | None = None


class ErrorBody(BaseModel):
    """The error: a stable code for programs, a message for people."""

    code: str = Field(examples=["invalid_request"])
    message: str = Field(examples=["q[0][3] is nan, expected a finite number"])
    detail: list[Problem] = []


class ErrorResponse(BaseModel):
    """The body of every response with a status of 400 and above."""

    error: ErrorBody


class ServiceError(Exception):
    """An error that a client can act on; subclasses fix status and code."""

    status = 500
    code = "internal_error"

    def __init__(self, message: str, detail: Sequence[Problem] = (), headers: Mapping[str, str] | None = None) -> None:
        super().__init__(message)
        self.message, self.detail, self.headers = message, list(detail), dict(headers or {})


class InvalidRequestError(ServiceError):
    """A value in the request is wrong: `detail` names the field and what was expected."""

    status, code = 422, "invalid_request"


class InvalidDataError(ServiceError):
    """The uploaded file cannot be used: `detail` names the place and what was expected."""

    status, code = 422, "invalid_data"


class NotFoundError(ServiceError):
    """The data set, job, model or version does not exist."""

    status, code = 404, "not_found"


class ConflictError(ServiceError):
    """The request conflicts with the present state of a resource; the message says why."""

    status, code = 409, "conflict"


class NoServingVersionError(ServiceError):
    """The model has no serving version: all its versions are candidates."""

    status, code = 409, "no_serving_version"


class TooLargeError(ServiceError):
    """The body exceeds a limit."""

    status, code = 413, "too_large"


class UnsupportedMediaTypeError(ServiceError):
    """The media type of the body is not accepted here."""

    status, code = 415, "unsupported_media_type"


class UnauthorizedError(ServiceError):
    """The API key is missing, unknown, expired or revoked."""

    status, code = 401, "unauthorized"


class ForbiddenError(ServiceError):
    """The API key lacks the scope for this, or the request comes from a web page of another site."""

    status, code = 403, "forbidden"


class RequestTimeoutError(ServiceError):
    """The body arrived too slowly."""

    status, code = 408, "request_timeout"


class BusyError(ServiceError):
    """A queue is full: retry later."""

    status, code = 429, "busy"


class RateLimitedError(ServiceError):
    """Too many requests in a short time: retry after the time in the header `Retry-After`."""

    status, code = 429, "rate_limited"


class NotReadyError(ServiceError):
    """The service cannot answer at present: retry later."""

    status, code = 503, "not_ready"


class RevisionNotReachedError(ServiceError):
    """The version has not reached the required revision: retry after the time in the header `Retry-After`."""

    status, code = 503, "revision_not_reached"


class StorageUnavailableError(ServiceError):
    """The database or the disk cannot be written at present. Nothing was stored: retry."""

    status, code = 503, "storage_unavailable"


class StorageFullError(ServiceError):
    """The disk or the quota is full. Nothing was stored: delete data sets or versions."""

    status, code = 507, "storage_full"


class NotInstalledError(ServiceError):
    """The service lacks packages for this: `detail` names the extra and the command that installs it."""

    status, code = 501, "not_installed"


class DamagedDataError(ServiceError):
    """The stored data set is damaged: its checksum has changed."""

    status, code = 500, "damaged_data"


class UnreadableVersionError(ServiceError):
    """The files of the version are damaged, or have a format that this release does not read."""

    status, code = 500, "unreadable_version"


def problem(field: str, value: object, expected: str, message: str | None = None) -> Problem:
    """Return the description of one wrong value; long values and deep nesting are cut.

    `message` is the sentence for people, for cases in which "field is value, expected …" is not plain English.
    """
    text = value if isinstance(value, str) else _REPR.repr(value)
    text = text if len(text) <= 200 else text[:200] + "…"
    found = Problem(field=readable(field[:200]), value=readable(text), expected=expected)
    found._message = None if message is None else readable(message)
    return found


def readable(text: str) -> str:
    """Escape characters that a terminal or log does not show: control and bidirectional characters, lone surrogates."""
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)


def sentence(item: Problem) -> str:
    """Return the problem as one sentence."""
    return item._message or f"{item.field} is {item.value}, expected {item.expected}"


def invalid_request(field: str, value: object, expected: str, message: str | None = None) -> InvalidRequestError:
    """Return the error for one wrong value of a request."""
    item = problem(field, value, expected, message)
    return InvalidRequestError(sentence(item), [item])


def invalid_data(field: str, value: object, expected: str, message: str | None = None) -> InvalidDataError:
    """Return the error for one fault in an uploaded data set."""
    item = problem(field, value, expected, message)
    return InvalidDataError(sentence(item), [item])


def not_installed(error: MissingExtraError) -> NotInstalledError:
    """Return the error for an extra that is not installed."""
    return NotInstalledError(str(error), [problem("extra", error.extra, install_line(error.extra))])


def not_found(kind: str, name: object) -> NotFoundError:
    """Return the error for something that does not exist."""
    return NotFoundError(f"no {kind} {str(name)[:200]!r}", [problem(kind, str(name), f"an existing {kind}")])

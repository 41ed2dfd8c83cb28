"""Sending of calls, shared by both clients: errors, requests, files, server-sent events, retries.

A call is repeated after a lost connection, and after 429 or 503 with Retry-After, but only if repetition is safe. If
the service has answered this client before, the client waits for its restart; otherwise it fails at once.
"""

from __future__ import annotations

import json
import random
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import httpx
import msgspec

from lipserve import __version__
from lipserve.call import Answer, Call, T


class ServiceUnreachableError(ConnectionError):
    """No service answers at the address, or the connection was lost.

    Example:
        >>> try:
        ...     Client("http://127.0.0.1:9", retries=0).health()
        ... except ServiceUnreachableError as error:
        ...     print(error)
    """


class ApiError(RuntimeError):
    """The service rejected a request, or its answer cannot be read by this release (code `unreadable_answer`).

    Attributes:
        status: HTTP status.
        code: Error code of the service.
        message: Text for people.
        detail: Problems, with field, value and expected.
        retry_after: Time to wait before a retry, s; None if the service does not say.

    Example:
        >>> try:
        ...     client.model("nobody")
        ... except ApiError as error:
        ...     print(error.status, error.code)
        404 not_found
    """

    def __init__(
        self, status: int, code: str, message: str, detail: list[dict[str, Any]], retry_after: float | None = None
    ) -> None:
        super().__init__(message)
        self.status, self.code, self.message, self.detail, self.retry_after = status, code, message, detail, retry_after


def refused(status: int, body: bytes, retry_after: float | None = None) -> ApiError:
    """Return the error that an answer describes."""
    try:
        error = json.loads(body)["error"]
        if isinstance(error, str):  # below /v2
            return ApiError(status, "http_error", error, [], retry_after)
        return ApiError(status, error["code"], error["message"], error["detail"], retry_after)
    except (ValueError, KeyError, TypeError):
        return ApiError(status, "http_error", body[:500].decode(errors="replace"), [], retry_after)


def result_of(call: Call[T], answer: Answer) -> T:
    """Return the result of an answer or a server-sent event; raise ApiError if this release cannot read it."""
    try:
        return call.read(answer)
    except msgspec.DecodeError as error:
        message = (
            f"The answer to {call.method} {call.path} could not be read: {error}. "
            f"Install the client of the service's release; this is {__version__}."
        )
        raise ApiError(answer.status, "unreadable_answer", message, []) from error


CHUNK = 1 << 18
"""Bytes of a file sent at once."""


def request_of(call: Call[Any]) -> dict[str, Any]:
    """Return the arguments of httpx for a call, without the content of a file."""
    arguments: dict[str, Any] = {
        "method": call.method,
        "url": call.path,
        "params": call.params,
        "headers": call.headers,
    }
    if call.json is not None:
        arguments["json"] = call.json
    if call.timeout is not None:
        arguments["timeout"] = call.timeout
    return arguments


def answer_of(response: httpx.Response, body: bytes = b"") -> Answer:
    """Return the answer in a response. body: empty if it was saved to a file."""
    return Answer(response.status_code, body, response.headers)


@contextmanager
def content_of(call: Call[Any]) -> Iterator[Iterator[bytes] | None]:
    """Yield the pieces of the file that a call sends, with a progress bar if requested; None without a file."""
    if call.file is None:
        yield None
        return
    with ExitStack() as stack:
        file = stack.enter_context(call.file.open("rb"))
        content: Iterator[bytes] = iter(partial(file.read, CHUNK), b"")
        if call.shown is not None:
            from lipserve.progress import upload_bar  # noqa: PLC0415 - Rich is optional

            content = stack.enter_context(upload_bar(call.shown, call.file.stat().st_size))(content)
        yield content


@contextmanager
def drafted(path: Path) -> Iterator[BinaryIO]:
    """Yield a temporary file that replaces `path` if the block succeeds."""
    draft = path.with_name(f"{path.name}.part")
    try:
        with draft.open("wb") as file:
            yield file
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


class Events:
    """Parser of server-sent events."""

    def __init__(self) -> None:
        self._event, self._data = "", list[str]()

    def add_line(self, line: str) -> Answer | None:
        """Add a line without its end; return the event if the line completes one."""
        if line.startswith("event:"):
            self._event = line.removeprefix("event:").strip()
        elif line.startswith("data:"):
            self._data.append(line.removeprefix("data:").removeprefix(" "))
        elif not line:
            event = Answer(200, "\n".join(self._data).encode(), event=self._event) if self._data else None
            self._event, self._data = "", []
            return event
        return None  # comment lines only keep the connection alive


RETRIES = 6
"""Max number of repetitions: with these pauses a service has three to six seconds to restart."""
FIRST_PAUSE_S, MAX_PAUSE_S = 0.1, 10.0
"""Pauses double, starting with the first. If the service asks for more than the max, the call fails."""
LATER = (429, 503)
NOT_FOUND = 404


@dataclass
class Reach:
    """State of the connection to a service. reached: whether it has answered this client."""

    url: str
    retries: int = RETRIES
    reached: bool = False


class Attempts:
    """Attempts to send one call."""

    def __init__(self, call: Call[Any], reach: Reach) -> None:
        self._call, self._reach = call, reach
        self._made = 0
        self._lost = False

    def after_error(self, error: httpx.TransportError, begun: bool = False) -> float:
        """Return the pause before the next attempt, s; raise ServiceUnreachableError if there is none.

        Calls that time out are not repeated, because this would add load. begun: whether events had arrived.
        """
        if begun:
            raise ServiceUnreachableError(
                f"the connection to the service at {self._reach.url} was lost ({error})"
            ) from error
        timed_out = isinstance(error, httpx.TimeoutException)
        unknown = isinstance(error, httpx.ConnectError) and not self._reach.reached
        if not self._call.repeatable or timed_out or unknown or self._made >= self._reach.retries:
            cause = "timeout" if timed_out else error
            raise ServiceUnreachableError(
                f"no service answers at {self._reach.url} ({cause}): start one with `lipserve serve`"
                if not self._reach.reached
                else f"the service at {self._reach.url} does not answer any more ({cause})"
            ) from error
        self._lost = True
        return self._pause()

    def after_answer(self, answer: Answer) -> float | None:
        """Return the pause before the next attempt, s, or None if the answer is final; raise ApiError."""
        self._reach.reached = True
        if answer.status < 400:
            return None
        if self._call.removes and self._lost and answer.status == NOT_FOUND:
            return None  # removed by the attempt that lost its answer
        after = _retry_after(answer.headers)
        patient = self._call.repeatable and self._made < self._reach.retries
        if answer.status in LATER and patient and after is not None and after <= MAX_PAUSE_S:
            return max(after, self._pause())
        raise refused(answer.status, answer.body, after)

    def _pause(self) -> float:
        """Return a pause that doubles each time, with a random part so that clients do not retry together."""
        self._made += 1
        longest = min(FIRST_PAUSE_S * 2.0 ** (self._made - 1), MAX_PAUSE_S)
        return longest * random.uniform(0.5, 1.0)  # noqa: S311 - no secret


def _retry_after(headers: Mapping[str, str]) -> float | None:
    seconds = headers.get("retry-after", "")
    return float(seconds) if seconds.isascii() and seconds.isdigit() else None

"""What both clients share of sending a call: errors, requests, files, server-sent events, attempts.

A lost connection, and answers 429 and 503 that say when to come back, are no reason to give up at once; but only for
calls that do the same however often they arrive. A service that has answered this client before is waited for while it
starts again; one that never has is told to be missing at once.
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
    """No service answers at the address, or the connection to it was lost."""


class ApiError(RuntimeError):
    """The service refused a request, or answered it as another release does: code `unreadable_answer`.

    status: of HTTP; code, message, detail: as the service says; retry_after: seconds after which it may be tried again,
    where the service says so.
    """

    def __init__(
        self, status: int, code: str, message: str, detail: list[dict[str, Any]], retry_after: float | None = None
    ) -> None:
        super().__init__(message)
        self.status, self.code, self.message, self.detail, self.retry_after = status, code, message, detail, retry_after


def refused(status: int, body: bytes, retry_after: float | None = None) -> ApiError:
    """The error that an answer tells."""
    try:
        error = json.loads(body)["error"]
        if isinstance(error, str):  # below /v2
            return ApiError(status, "http_error", error, [], retry_after)
        return ApiError(status, error["code"], error["message"], error["detail"], retry_after)
    except (ValueError, KeyError, TypeError):
        return ApiError(status, "http_error", body[:500].decode(errors="replace"), [], retry_after)


def result_of(call: Call[T], answer: Answer) -> T:
    """Return what an answer or a server-sent event says; raise ApiError if this release cannot read it."""
    try:
        return call.read(answer)
    except msgspec.DecodeError as error:
        message = (
            f"The answer to {call.method} {call.path} cannot be read: {error}. "
            f"Use the client of the service's release; this is {__version__}."
        )
        raise ApiError(answer.status, "unreadable_answer", message, []) from error


CHUNK = 1 << 18
"""Bytes of a file that are sent together."""


def request_of(call: Call[Any]) -> dict[str, Any]:
    """How httpx is to be asked, but for the content of a file."""
    asked: dict[str, Any] = {"method": call.method, "url": call.path, "params": call.params, "headers": call.headers}
    if call.json is not None:
        asked["json"] = call.json
    if call.timeout is not None:
        asked["timeout"] = call.timeout
    return asked


def answer_of(response: httpx.Response, body: bytes = b"") -> Answer:
    """What came back; body: empty where it was written to a file."""
    return Answer(response.status_code, body, response.headers)


@contextmanager
def content_of(call: Call[Any]) -> Iterator[Iterator[bytes] | None]:
    """The file that a call sends, in pieces, with a bar where that is to be shown; None where it sends none."""
    if call.file is None:
        yield None
        return
    with ExitStack() as stack:
        file = stack.enter_context(call.file.open("rb"))
        content: Iterator[bytes] = iter(partial(file.read, CHUNK), b"")
        if call.shown is not None:
            from lipserve.progress import upload_bar  # noqa: PLC0415 - rich, for those who look

            content = stack.enter_context(upload_bar(call.shown, call.file.stat().st_size))(content)
        yield content


@contextmanager
def drafted(path: Path) -> Iterator[BinaryIO]:
    """A file to be written in the block, which is there once it is whole, or not at all."""
    draft = path.with_name(f"{path.name}.part")
    try:
        with draft.open("wb") as file:
            yield file
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


class Events:
    """Server-sent events of the lines of an answer."""

    def __init__(self) -> None:
        self._event, self._data = "", list[str]()

    def take(self, line: str) -> Answer | None:
        """Take a line, without its end; return the event that it completes, None where it completes none."""
        if line.startswith("event:"):
            self._event = line.removeprefix("event:").strip()
        elif line.startswith("data:"):
            self._data.append(line.removeprefix("data:").removeprefix(" "))
        elif not line:
            event = Answer(200, "\n".join(self._data).encode(), event=self._event) if self._data else None
            self._event, self._data = "", []
            return event
        return None  # comments keep the connection alive


RETRIES = 6
"""Most times that a call is repeated: with these pauses a service may take three to six seconds to start again."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 10.0
"""Pauses double from the first on; a service that asks for more than the longest is not waited for."""
LATER = (429, 503)
NOT_FOUND = 404


@dataclass
class Reach:
    """What is known of a service. url: as people name it; retries: most repetitions of a call; reached: whether it has
    answered since the client was made."""

    url: str
    retries: int = RETRIES
    reached: bool = False


class Attempts:
    """The attempts at one call."""

    def __init__(self, call: Call[Any], reach: Reach) -> None:
        self._call, self._reach = call, reach
        self._made = 0
        self._lost = False

    def lost(self, error: httpx.TransportError, begun: bool = False) -> float:
        """Return after how many seconds to try again; raise ServiceUnreachableError where that is no use.

        What takes too long is not asked again: that would only add to the load. begun: events had come already.
        """
        if begun:
            raise ServiceUnreachableError(f"the service at {self._reach.url} is lost ({error})") from error
        timed_out = isinstance(error, httpx.TimeoutException)
        unknown = isinstance(error, httpx.ConnectError) and not self._reach.reached
        if not self._call.repeatable or timed_out or unknown or self._made >= self._reach.retries:
            what = "takes longer than it may" if timed_out else f"({error})"
            raise ServiceUnreachableError(
                f"no service answers at {self._reach.url} {what}: start one with `lipserve serve`"
                if not self._reach.reached
                else f"the service at {self._reach.url} does not answer any more {what}"
            ) from error
        self._lost = True
        return self._pause()

    def answered(self, answer: Answer) -> float | None:
        """Return after how many seconds to try again, None where this is the answer; raise ApiError."""
        self._reach.reached = True
        if answer.status < 400:
            return None
        if self._call.removes and self._lost and answer.status == NOT_FOUND:
            return None  # removed by the attempt whose answer was lost
        after = _retry_after(answer.headers)
        patient = self._call.repeatable and self._made < self._reach.retries
        if answer.status in LATER and patient and after is not None and after <= LONGEST_PAUSE_S:
            return max(after, self._pause())
        raise refused(answer.status, answer.body, after)

    def _pause(self) -> float:
        """Twice as long each time, and never the same: many clients lose a service at once."""
        self._made += 1
        longest = min(FIRST_PAUSE_S * 2.0 ** (self._made - 1), LONGEST_PAUSE_S)
        return longest * random.uniform(0.5, 1.0)  # noqa: S311 - no secret


def _retry_after(headers: Mapping[str, str]) -> float | None:
    seconds = headers.get("retry-after", "")
    return float(seconds) if seconds.isascii() and seconds.isdigit() else None

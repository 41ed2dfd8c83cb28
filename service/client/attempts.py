"""When a call is made again: without any transport, for both clients.

A lost connection, and answers 429 and 503 that say when to come back, are no reason to give up at once; but only for
calls that do the same however often they arrive. A service that has answered this client before is waited for while it
starts again; one that never has is told to be missing at once.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import httpx

from service.client.call import Answer, Call
from service.client.errors import ApiError, ServiceUnreachableError, refused

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

    def lost(self, error: httpx.TransportError) -> float:
        """Return after how many seconds to try again; raise ServiceUnreachableError where that is no use.

        What takes too long is not asked again: that would only add to the load.
        """
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
        raise self.refusal(answer)

    @staticmethod
    def refusal(answer: Answer) -> ApiError:
        """The error that an answer tells."""
        return refused(answer.status, answer.body, _retry_after(answer.headers))

    def _pause(self) -> float:
        """Twice as long each time, and never the same: many clients lose a service at once."""
        self._made += 1
        longest = min(FIRST_PAUSE_S * 2.0 ** (self._made - 1), LONGEST_PAUSE_S)
        return longest * random.uniform(0.5, 1.0)  # noqa: S311 - no secret


def _retry_after(headers: Mapping[str, str]) -> float | None:
    said = headers.get("retry-after", "")
    return float(said) if said.isascii() and said.isdigit() else None

"""Whether the service can do what it is for: each part is checked, and named; whether it is about to stop."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from service.contract.states import PartState


class Stopping:
    """begun: the service was told to stop, and says so, though it may still answer.

    closing: set when it takes no more connections: who would answer for long, as with events, ends now.
    """

    def __init__(self) -> None:
        self.begun = False
        self.closing = asyncio.Event()


KEPT_S = 1.0
"""Seconds for which a report holds: however many ask, a part is looked at once in this time."""


class Lasting(Protocol):
    """For how many seconds something has been wrong whenever it was looked at; None where it is not wrong now."""

    def __call__(self, wrong: bool, what: str = "") -> float | None:
        """wrong: whether it is so now; what: it is, where a part asks for several things."""
        ...


Look = Callable[[Lasting], tuple[PartState, str]]
"""Looks at one part and says in words how it is; may raise whatever the part raises."""


@dataclass(frozen=True)
class Check:
    """One part: warning where some clients may notice, failed where the service should get no requests."""

    name: str
    state: PartState
    message: str


class Readiness:
    """Looks at the parts of a service, at most once every KEPT_S; safe from several threads, not for the event loop.

    looks: of each part, by its name; clock: seconds that only rise.
    """

    def __init__(
        self, looks: Mapping[str, Look], stopping: Stopping, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.looks, self._stopping = looks, stopping
        self._clock, self._lock = clock, threading.Lock()
        self._report, self._until = tuple[Check, ...](), -float("inf")
        self._wrong_since: dict[tuple[str, str], float] = {}

    def report(self) -> tuple[Check, ...]:
        """How all parts are, just now or within the last KEPT_S; never raises."""
        with self._lock:
            if self._clock() >= self._until:
                self._report = tuple(self._check(name, look) for name, look in self.looks.items())
                self._until = self._clock() + KEPT_S
            if self._stopping.begun:
                return Check("stopping", "failed", "the service is stopping"), *self._report
            return self._report

    def forget(self) -> None:
        """Look again when asked next."""
        with self._lock:
            self._until = -float("inf")

    def _check(self, name: str, look: Look) -> Check:
        try:
            return Check(name, *look(partial(self._lasting, name)))
        except Exception as error:  # whatever it is, the part does not work
            reason = getattr(error, "strerror", None) or error  # without paths: whoever reads this needs no key
            return Check(name, "failed", f"{type(error).__name__}: {reason}")

    def _lasting(self, part: str, wrong: bool, what: str = "") -> float | None:
        if not wrong:
            self._wrong_since.pop((part, what), None)
            return None
        return self._clock() - self._wrong_since.setdefault((part, what), self._clock())

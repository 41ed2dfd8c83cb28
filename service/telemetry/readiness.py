"""Readiness of the service: the state of each part, and whether the service is stopping."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from service.contract.states import PartState


class StopState:
    """Stages of a stop.

    - begun: whether the stop was requested. The service reports that it is not ready, but may still answer.
    - closing: set once new connections are refused; long responses, such as event streams, then end.
    """

    def __init__(self) -> None:
        self.begun = False
        self.closing = asyncio.Event()


MAX_REPORT_AGE_S = 1.0
"""Seconds for which a report is reused: each part is checked at most once in this time."""


class FaultAge(Protocol):
    """Returns the seconds since a fault was first seen without a break; None if the fault is gone."""

    def __call__(self, wrong: bool, what: str = "") -> float | None:
        """Report whether the part is faulty now. what: name of the fault, if a part has several."""
        ...


Probe = Callable[[FaultAge], tuple[PartState, str]]
"""Checks one part and describes its state in words; may raise any error of the part."""


@dataclass(frozen=True)
class Check:
    """The state of one part: `warning` if some clients may notice, `failed` if the service should get no requests."""

    name: str
    state: PartState
    message: str


class Readiness:
    """Checks the parts of a service at most once every MAX_REPORT_AGE_S.

    Safe from several threads. Blocking: use it in a thread.

    probes: probe of each part, by the name of the part. clock: monotonic time, s.
    """

    def __init__(
        self, probes: Mapping[str, Probe], stopping: StopState, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.probes, self._stopping = dict(probes), stopping
        self._clock, self._lock = clock, threading.Lock()
        self._report, self._until = tuple[Check, ...](), -float("inf")
        self._wrong_since: dict[tuple[str, str], float] = {}

    def add(self, name: str, probe: Probe) -> None:
        """Add a part."""
        self.probes[name] = probe

    def report(self) -> tuple[Check, ...]:
        """Return the state of all parts, at most MAX_REPORT_AGE_S old; never raise."""
        with self._lock:
            if self._clock() >= self._until:
                self._report = tuple(self._check(name, probe) for name, probe in list(self.probes.items()))
                self._until = self._clock() + MAX_REPORT_AGE_S
            if self._stopping.begun:
                return Check("stopping", "failed", "the service is stopping"), *self._report
            return self._report

    def forget(self) -> None:
        """Check all parts again at the next report."""
        with self._lock:
            self._until = -float("inf")

    def _check(self, name: str, probe: Probe) -> Check:
        try:
            return Check(name, *probe(partial(self._lasting, name)))
        except Exception as error:  # a part that raises any error does not work
            reason = getattr(error, "strerror", None) or error  # without paths: this report is public
            return Check(name, "failed", f"{type(error).__name__}: {reason}")

    def _lasting(self, part: str, wrong: bool, what: str = "") -> float | None:
        """Return how long a fault of a part has lasted, s; None if it is gone. See `FaultAge`."""
        if not wrong:
            self._wrong_since.pop((part, what), None)
            return None
        return self._clock() - self._wrong_since.setdefault((part, what), self._clock())

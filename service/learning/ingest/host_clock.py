"""The clock of the host, which may be wrong when the service starts, and set right while it runs."""

from __future__ import annotations

import time

SET_S = 1.0
"""A clock that differs from even time by more than this, s, was set; less is how a clock is kept right."""
_EVEN = getattr(time, "CLOCK_BOOTTIME", getattr(time, "CLOCK_MONOTONIC", None))
"""Nobody sets this one, and unlike `time.monotonic` it goes on while the machine sleeps."""


class HostClock:
    """Tells when the host's clock was set; from one thread at a time."""

    def __init__(self) -> None:
        self._offset = _offset()

    def step(self) -> float:
        """By how much it was set since this was asked last, s; 0 where it was not."""
        offset = _offset()
        step = offset - self._offset
        if abs(step) <= SET_S:
            return 0.0
        self._offset = offset
        return step


def _offset() -> float:
    """Unix time less even time, s."""
    return time.time() - (time.monotonic() if _EVEN is None else time.clock_gettime(_EVEN))

"""The clock of the host, which may be wrong when the service starts, and set right while it runs."""

from __future__ import annotations

import time

SET_S = 1.0
"""A clock that differs from even time by more than this, s, was set; less is how a clock is kept right."""


class HostClock:
    """Tells when the host's clock was set; from one thread at a time."""

    def __init__(self) -> None:
        self._offset = time.time() - time.monotonic()

    def step(self) -> float:
        """By how much it was set since this was asked last, s; 0 where it was not."""
        offset = time.time() - time.monotonic()
        step = offset - self._offset
        if abs(step) <= SET_S:
            return 0.0
        self._offset = offset
        return step

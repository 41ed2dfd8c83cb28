"""The host's clock, and the times that follow it.

The clock may be wrong when the service starts, and be set while the service runs.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping

from sqlalchemy import case, func, select, update

from lipcore.online.dating import LEAP_S
from service.learning.ingest.monitor import Monitor
from service.storage.database import Database, StreamRow

logger = logging.getLogger(__name__)

MIN_STEP_S = 1.0
"""Min difference to the boot clock, s, that counts as a set clock. Smaller ones are ordinary corrections."""
_BOOT_CLOCK = getattr(time, "CLOCK_BOOTTIME", getattr(time, "CLOCK_MONOTONIC", None))
"""A clock that nobody sets. Unlike `time.monotonic`, it also runs while the machine sleeps."""


class HostClock:
    """Detects that the host's clock was set; from one thread at a time."""

    def __init__(self) -> None:
        self._offset = _offset()

    def step(self) -> float:
        """Return by how much the clock was set since the last call, s; 0 if it was not."""
        offset = _offset()
        step = offset - self._offset
        if abs(step) <= MIN_STEP_S:
            return 0.0
        self._offset = offset
        return step


def _offset() -> float:
    """Return Unix time minus the boot clock, s."""
    return time.time() - (time.monotonic() if _BOOT_CLOCK is None else time.clock_gettime(_BOOT_CLOCK))


class StreamClocks:
    """Dates arrivals, and moves stored times after the host's clock was set; safe from several threads.

    monitors: returns the existing monitors.
    """

    def __init__(self, database: Database, monitors: Callable[[], Mapping[str, Monitor]]) -> None:
        self._database, self._monitors = database, monitors
        self._host, self._lock = HostClock(), threading.Lock()
        self._check_at_start()

    def date_arrival(self) -> float:
        """Return the time of a batch that arrives now, Unix time, s.

        If the host's clock was set, move stored times first.
        """
        with self._lock:
            step = self._host.step()
            if step:
                logger.warning("the clock of this machine was set by %+.1f s", step)
                self._move(step)
        return time.time()

    def _check_at_start(self) -> None:
        """Move stored times if the host's clock was set back while no service ran. Call it before the first batch."""
        with self._database.session() as session:
            newest = session.scalar(select(func.max(StreamRow.received)))
        if self._database.own_clock and newest is not None and (step := time.time() - newest) < -LEAP_S:
            logger.warning("the clock of this machine was set by %+.1f s while no service ran", step)
            self._move(step)

    def _move(self, step: float) -> None:
        """Move the times of this machine's clock by `step`, s.

        Times in a shared database stay, because other machines' clocks wrote them too.
        """
        if self._database.own_clock:
            offset = case((StreamRow.offset == 0, 0.0), else_=StreamRow.offset + step)
            with self._database.transaction() as session:
                session.execute(update(StreamRow).values(offset=offset, received=StreamRow.received + step))
        for monitor in self._monitors().values():
            with monitor.lock:
                monitor.set_clock(step)

"""The clock of the host, which may be wrong when the service starts, and set right while it runs; and what is dated by
it."""

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


class StreamClocks:
    """Dates arrivals, and moves what is dated by the host's clock if that was set; safe from several threads.

    monitors: returns the monitors that there are.
    """

    def __init__(self, database: Database, monitors: Callable[[], Mapping[str, Monitor]]) -> None:
        self._database, self._monitors = database, monitors
        self._host, self._lock = HostClock(), threading.Lock()
        self._check_at_start()

    def arrival(self) -> float:
        """Return the time of a batch that arrives now, Unix time, s. If the host's clock was set, first move what is
        dated by it."""
        with self._lock:
            step = self._host.step()
            if step:
                logger.warning("the clock of this machine was set by %+.1f s", step)
                self._move(step)
        return time.time()

    def _check_at_start(self) -> None:
        """Move streams to the host's clock if it was set back while no service ran; before the first batch."""
        with self._database.session() as session:
            newest = session.scalar(select(func.max(StreamRow.received)))
        if self._database.own_clock and newest is not None and (step := time.time() - newest) < -LEAP_S:
            logger.warning("the clock of this machine was set by %+.1f s while no service ran", step)
            self._move(step)

    def _move(self, step: float) -> None:
        """Move what is dated by this machine's clock by `step`, s. Where the clocks of other services date streams,
        too, these stay as they are."""
        if self._database.own_clock:
            offset = case((StreamRow.offset == 0, 0.0), else_=StreamRow.offset + step)
            with self._database.transaction() as session:
                session.execute(update(StreamRow).values(offset=offset, received=StreamRow.received + step))
        for monitor in self._monitors().values():
            with monitor.lock:
                monitor.set_clock(step)

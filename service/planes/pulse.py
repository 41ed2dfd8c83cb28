"""The heartbeats of the planes, in a page of memory that all their processes share."""

from __future__ import annotations

import mmap
import os
import time
from collections.abc import Callable
from contextlib import suppress
from enum import IntEnum
from pathlib import Path
from struct import Struct
from typing import NamedTuple

from service.contract.states import PartState
from service.telemetry.readiness import FaultAge

BEAT_S = 0.05
"""Seconds between two beats of an event loop."""
MAX_STARVED_S = 5.0
"""Max silence of a process that the system gives no processor, s."""
RESTART_WARNING_S = 600.0
"""Seconds for which readiness mentions a restart."""
_BEAT, _RESTART = Struct("<QQ"), Struct("<Qd")
_ROW = _BEAT.size + _RESTART.size


class Plane(IntEnum):
    """The planes, as rows of the page."""

    CONTROL = 0
    DATA = 1


class Beat(NamedTuple):
    """A process and its number of beats; zeros before the first one."""

    pid: int
    number: int


class Pulse:
    """Heartbeats and restarts of both planes. A plane writes its beats, the supervisor writes restarts."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._page, self._clock = mmap.mmap(-1, mmap.PAGESIZE), clock

    def beat(self, plane: Plane) -> None:
        """Record a beat of this process."""
        number = self.last_beat(plane).number + 1
        _BEAT.pack_into(self._page, plane * _ROW, os.getpid(), number)

    def last_beat(self, plane: Plane) -> Beat:
        """Return the last beat of a plane."""
        return Beat(*_BEAT.unpack_from(self._page, plane * _ROW))

    def record_restart(self, plane: Plane) -> None:
        """Count a restart of a plane."""
        _RESTART.pack_into(self._page, plane * _ROW + _BEAT.size, self.restarts(plane)[0] + 1, self._clock())

    def restarts(self, plane: Plane) -> tuple[int, float]:
        """Return the number of restarts of a plane, and the seconds since the last one."""
        count, at = _RESTART.unpack_from(self._page, plane * _ROW + _BEAT.size)
        return count, self._clock() - at

    def check(self, _: FaultAge) -> tuple[PartState, str]:
        """Check the planes, for readiness: a warning for some minutes after each restart."""
        told = []
        for plane in Plane:
            count, ago = self.restarts(plane)
            if count and ago < RESTART_WARNING_S:
                times = "once" if count == 1 else f"{count} times"
                told.append(f"the {plane.name.lower()} plane was restarted {times}, the last time {ago:.0f} s ago")
        return ("warning", "; ".join(told)) if told else ("ok", "both planes work")


class Watch:
    """Watches the beats of a plane. A gap between two looks does not count: the watching process was stopped too."""

    def __init__(
        self, pulse: Pulse, plane: Plane, max_silent_s: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.plane, self._pulse, self._max_s, self._clock = plane, pulse, max_silent_s, clock
        self._last, self._looked = Beat(0, 0), clock()
        self._at, self._cpu_s = self._looked, 0.0

    def silent(self) -> tuple[int, float] | None:
        """Return the process that hangs and the seconds for which it is silent; None if there is none."""
        now, beat = self._clock(), self._pulse.last_beat(self.plane)
        gap, self._looked = now - self._looked, now
        if beat != self._last or gap > self._max_s / 2:
            self._last, self._at = beat, now
            self._cpu_s = cpu_s(beat.pid) or 0.0
        silent_s = now - self._at
        if not beat.pid or silent_s <= self._max_s:
            return None
        return None if self._is_starved(beat.pid, silent_s) else (beat.pid, silent_s)

    def restart(self) -> None:
        """Count the silence from now on."""
        self._at = self._clock()

    def _is_starved(self, pid: int, silent_s: float) -> bool:
        """Return whether a process wants to run but gets no processor: then its replacement would not run either."""
        spent = cpu_s(pid)
        if spent is None or silent_s > max(MAX_STARVED_S, self._max_s):
            return False
        return is_runnable(pid) and spent - self._cpu_s < silent_s / 2


def cpu_s(pid: int) -> float | None:
    """Return the processor time of a process, s; None if it has ended."""
    with suppress(OSError, ValueError, IndexError):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return None


def is_runnable(pid: int) -> bool:
    """Return whether a thread of a process runs or waits for a processor."""
    for path in Path(f"/proc/{pid}/task").glob("*/stat"):
        with suppress(OSError, IndexError):
            if path.read_text().rpartition(")")[2].split()[0] == "R":
                return True
    return False

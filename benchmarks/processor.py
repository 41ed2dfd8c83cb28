"""Processor time that other programs and machines used during a measurement. Zero on systems other than Linux."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from benchmarks.processes import PROC, levels, stats

IS_AVAILABLE = (PROC / "stat").exists()
"""Whether the system reports processor time."""
_BUSY, _STOLEN = (0, 1, 2, 5, 6), 7
"""Fields of /proc/stat: user, nice, system, irq and softirq; steal."""
_TIMES = (11, 12, 13, 14)
"""Fields of /proc/PID/stat after the name: user and system time of the process and of its ended children."""


@dataclass
class Usage:
    """Wall time of a measurement and processor time used by others meanwhile, s.

    Attributes:
        others: of processes outside the benchmark, the kernel's included.
        stolen: of other virtual machines on the same host.
    """

    wall: float = 0.0
    others: float = 0.0
    stolen: float = 0.0

    def __str__(self) -> str:
        return (
            f"{max(0.0, self.others / self.wall):.0%} of one core by other processes, "
            f"{self.stolen / self.wall:.1%} by other machines"
        )


@contextmanager
def watched(usage: Usage, service: int) -> Iterator[None]:
    """Add the time used by others; `service` and its children belong to the benchmark."""
    before = _read_times(service)
    yield
    after = _read_times(service)
    usage.wall += after[0] - before[0]
    usage.others += after[1] - before[1]
    usage.stolen += after[2] - before[2]


def seconds_below(pid: int, itself: bool = False) -> float:
    """Return processor time of all descendants of a process, s; with `itself`, of the process too."""
    known = dict(stats())
    counted = [each for level in levels(pid, known)[0 if itself else 1 :] for each in level if each in known]
    return sum(int(known[each][at]) for each in counted for at in _TIMES) / _hertz()


def _read_times(service: int) -> tuple[float, float, float]:
    """Return wall time, processor time of all but this process and the service, and stolen time, s."""
    if not IS_AVAILABLE:
        return time.monotonic(), 0.0, 0.0
    ticks = [int(value) for value in (PROC / "stat").read_text().split("\n", 1)[0].split()[1:]]
    busy = sum(ticks[each] for each in _BUSY) / _hertz()
    ours = time.process_time() + seconds_below(service, itself=True)
    return time.monotonic(), busy - ours, ticks[_STOLEN] / _hertz()


def _hertz() -> int:
    return os.sysconf("SC_CLK_TCK")

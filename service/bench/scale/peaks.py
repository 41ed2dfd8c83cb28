"""The most memory that each process of a service has had. Linux only; elsewhere nothing is found."""

from __future__ import annotations

import re
import threading
from types import TracebackType
from typing import Self

from service.bench.processor import PROC

PERIOD = 0.2
KINDS = ("service", "training", "statistics")
"""By depth: the service, what it has started (training and learner), and what those have (statistics of shards)."""


class Peaks:
    """Looks five times a second while it is entered. found: MiB at most of one process, by kind."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.found: dict[str, float] = {}
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def look(self) -> None:
        """Note what every process below has had so far."""
        for depth, pids in enumerate(_levels(self.pid)[: len(KINDS)]):
            for pid in pids:
                peak = resident(pid, "VmHWM") or 0.0
                self.found[KINDS[depth]] = max(self.found.get(KINDS[depth], 0.0), peak)

    def _watch(self) -> None:
        while not self._end.wait(PERIOD):
            self.look()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end.set()
        self._thread.join()


def resident(pid: int, name: str = "VmRSS") -> float | None:
    """Resident memory of a process, MiB: VmRSS now, VmHWM the most since it started; None where it has ended."""
    try:
        status = (PROC / str(pid) / "status").read_text()
    except OSError:
        return None
    found = re.search(rf"^{name}:\s+(\d+) kB", status, re.MULTILINE)
    return None if found is None else int(found.group(1)) / 1024


def _levels(pid: int) -> list[list[int]]:
    """Processes by their distance from one."""
    children: dict[int, list[int]] = {}
    for path in PROC.glob("[0-9]*/stat"):
        try:
            parent = int(path.read_text().rpartition(")")[2].split()[1])
        except (FileNotFoundError, ProcessLookupError):
            continue
        children.setdefault(parent, []).append(int(path.parent.name))
    levels = [[pid]]
    while below := [child for parent in levels[-1] for child in children.get(parent, [])]:
        levels.append(below)
    return levels

"""Peak memory of each process of a service. Linux only; elsewhere nothing is found."""

from __future__ import annotations

from benchmarks.processes import PeriodicCall, levels, resident_mib

PERIOD_S = 0.2
KINDS = ("service", "training", "statistics")
"""Kinds of processes by depth: the service; its children (training and learner); their children (statistics)."""


class Peaks(PeriodicCall):
    """A context manager that reads peaks every PERIOD_S; found: peak of one process by kind, MiB."""

    def __init__(self, pid: int) -> None:
        super().__init__(PERIOD_S, self.note)
        self.pid = pid
        self.found: dict[str, float] = {}

    def note(self) -> None:
        """Record the peaks so far."""
        for kind, pids in zip(KINDS, levels(self.pid), strict=False):
            for pid in pids:
                self.found[kind] = max(self.found.get(kind, 0.0), resident_mib(pid, "VmHWM") or 0.0)

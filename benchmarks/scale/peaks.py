"""The most memory that each process of a service has had. Linux only; elsewhere nothing is found."""

from __future__ import annotations

from benchmarks.processes import Watch, levels, resident

PERIOD = 0.2
KINDS = ("service", "training", "statistics")
"""By depth: the service, what it has started (training and learner), and what those have (statistics of shards)."""


class Peaks(Watch):
    """Looks five times a second while it is entered. found: MiB at most of one process, by kind."""

    def __init__(self, pid: int) -> None:
        super().__init__(PERIOD, self.note)
        self.pid = pid
        self.found: dict[str, float] = {}

    def note(self) -> None:
        """Note what every process below has had so far."""
        for kind, pids in zip(KINDS, levels(self.pid), strict=False):
            for pid in pids:
                self.found[kind] = max(self.found.get(kind, 0.0), resident(pid, "VmHWM") or 0.0)

"""Memory of the service while it is under load. Linux only."""

from __future__ import annotations

import numpy as np

from benchmarks.processes import Watch, levels, proportional

PERIOD = 1.0


class MemoryWatch(Watch):
    """Looks once a second while it is entered.

    service, children: MiB at each look, of the service's own process and of those that it has started; empty where the
    system does not tell. Memory that processes share counts once, in parts.
    """

    def __init__(self, pid: int) -> None:
        super().__init__(PERIOD, self.note)
        self.pid = pid
        self.service: list[float] = []
        self.children: list[float] = []

    def note(self) -> None:
        """Take down what there is now, while the service lives."""
        own = proportional(self.pid)
        if own is not None:
            self.service.append(own)
            below = [child for level in levels(self.pid)[1:2] for child in level]
            self.children.append(sum(proportional(child) or 0.0 for child in below))


def growth(looks: list[float]) -> float | None:
    """By which share the median of the last quarter exceeds that of the second; None for too few looks.

    The first quarter is left out: caches fill, and the learner process starts.
    """
    quarter = len(looks) // 4
    if quarter < 2:
        return None
    before, after = looks[quarter : 2 * quarter], looks[-quarter:]
    return float(np.median(after) / np.median(before) - 1)

"""What a service holds while it is under load: memory, descriptors, threads, processes, disk. Linux only."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.processes import PROC, Watch, levels, resident, written

WARMING = 0.1
"""Share of a run in which caches fill and processes start: what grows there is no leak."""
BLOCKS = 18
"""Parts of the rest, each of which counts by its median: a passing peak is no growth."""


@dataclass(frozen=True)
class Look:
    """What there was at a moment. at: by the clock of the watch, s.

    service, learner: memory that they have written, MiB, see `written`; jobs: that of all other processes below the
    service; descriptors, threads: of service and learner; processes: below the service; disk: MiB of its home.
    """

    at: float
    service: float
    learner: float
    jobs: float
    descriptors: float
    threads: float
    processes: float
    disk: float


class ResourceWatch(Watch):
    """Looks every so many seconds while it is entered. home: of the service, not measured where None; clock: by which
    looks are dated, s.

    looks: what there was; none where the system does not tell, and without a learner before it has started.
    """

    def __init__(
        self, pid: int, home: Path | None = None, clock: Callable[[], float] = time.monotonic, period: float = 1.0
    ) -> None:
        super().__init__(period, self.note)
        self.pid, self.home, self.clock, self.looks = pid, home, clock, list[Look]()
        self._learner: int | None = None

    def note(self) -> None:
        """Take down what there is now, while the service lives."""
        own = written(self.pid)
        if own is None:
            return
        below = [pid for level in levels(self.pid)[1:] for pid in level]
        learner = self._found(below)
        main = [self.pid] if learner is None else [self.pid, learner]
        self.looks.append(
            Look(
                at=self.clock(),
                service=own,
                learner=0.0 if learner is None else written(learner) or 0.0,
                jobs=sum(written(pid) or 0.0 for pid in below if pid != learner),
                descriptors=sum(_descriptors(pid) for pid in main),
                threads=sum(_threads(pid) for pid in main),
                processes=len(below),
                disk=0.0 if self.home is None else size(self.home),
            )
        )

    def _found(self, below: Sequence[int]) -> int | None:
        """The learner: the process below the service that computes first, before any job is queued."""
        if self._learner not in below:
            large = [pid for pid in below if (resident(pid) or 0.0) > LEARNER_MIB]
            self._learner = large[0] if large else None
        return self._learner


LEARNER_MIB = 60.0
"""Resident memory by which a process that computes is told from the one that only keeps account of shared memory."""


def _descriptors(pid: int) -> int:
    try:
        return len(os.listdir(PROC / str(pid) / "fd"))
    except OSError:  # it has ended
        return 0


def _threads(pid: int) -> int:
    try:
        return len(os.listdir(PROC / str(pid) / "task"))
    except OSError:
        return 0


def size(folder: Path) -> float:
    """What a folder takes of the disk, MiB."""
    blocks = 0
    for place, folders, files in os.walk(folder):  # which passes over what was deleted meanwhile
        for name in (*folders, *files):
            with suppress(FileNotFoundError):
                blocks += os.lstat(os.path.join(place, name)).st_blocks
    return blocks * 512 / (1 << 20)


def series(looks: Sequence[Look], name: str) -> list[float]:
    """One figure of all looks."""
    return [float(asdict(look)[name]) for look in looks]


@dataclass(frozen=True)
class Growth:
    """How a figure rises after the first tenth of a run, by the line of least squares. level: at the line's start."""

    level: float
    rise: float

    @property
    def share(self) -> float:
        """The rise over the level; 0 where there is nothing."""
        return self.rise / self.level if self.level > 0 else 0.0


def growth(looks: Sequence[float], at: Sequence[float] | None = None) -> Growth | None:
    """The line through the medians of the parts after the first tenth; None for too few looks.

    at: when they were taken, by the clock whose first tenth is left out; evenly where None.
    """
    times = np.arange(len(looks), dtype=float) if at is None else np.asarray(at, dtype=float)
    if len(times) < 2 * BLOCKS or times[-1] <= times[0]:
        return None
    share = (times - times[0]) / (times[-1] - times[0])
    part = np.floor(BLOCKS * (share - WARMING) / (1 - WARMING)).astype(int).clip(max=BLOCKS - 1)
    known = sorted(set(part[part >= 0].tolist()))
    medians = [float(np.median(np.asarray(looks)[part == number])) for number in known]
    slope, start = np.polyfit((np.array(known) + 0.5) / BLOCKS, medians, 1)
    return Growth(float(start), float(slope))

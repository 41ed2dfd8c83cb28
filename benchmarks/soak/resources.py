"""Resources of a service under load: memory, descriptors, threads, processes, disk. Linux only."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.processes import PROC, PeriodicCall, levels, resident_mib, written_mib

WARM_UP_SHARE = 0.1
"""Share of a run in which caches fill and processes start; growth there is no leak."""
BLOCKS = 18
"""Parts of the rest; each counts by its median, so that a short peak is no growth."""
LEARNER_MIB = 60.0
"""Min resident memory of the learner; the process that tracks shared memory has less."""


@dataclass(frozen=True)
class Look:
    """Resources at one moment.

    Attributes:
        at: time of the watch's clock, s.
        service: memory written by the service, MiB; see `written_mib`.
        learner: memory written by its learner, MiB.
        jobs: memory written by all other descendants of the service, MiB.
        descriptors: file descriptors of service and learner.
        threads: threads of service and learner.
        processes: descendants of the service.
        disk: size of the home, MiB.
    """

    at: float
    service: float
    learner: float
    jobs: float
    descriptors: float
    threads: float
    processes: float
    disk: float


class ResourceWatch(PeriodicCall):
    """A context manager that reads the resources of a service every `period` seconds.

    Attributes:
        pid: process id of the service.
        home: home of the service; None: its disk is not measured.
        clock: returns the time of a look, s.
        looks: the resources over time; empty on other systems than Linux.
    """

    def __init__(
        self, pid: int, home: Path | None = None, clock: Callable[[], float] = time.monotonic, period: float = 1.0
    ) -> None:
        super().__init__(period, self.note)
        self.pid, self.home, self.clock, self.looks = pid, home, clock, list[Look]()
        self._learner: int | None = None

    def note(self) -> None:
        """Record the present resources, if the service runs."""
        own = written_mib(self.pid)
        if own is None:
            return
        below = [pid for level in levels(self.pid)[1:] for pid in level]
        learner = self._find_learner(below)
        main = [self.pid] if learner is None else [self.pid, learner]
        self.looks.append(
            Look(
                at=self.clock(),
                service=own,
                learner=0.0 if learner is None else written_mib(learner) or 0.0,
                jobs=sum(written_mib(pid) or 0.0 for pid in below if pid != learner),
                descriptors=sum(_descriptors(pid) for pid in main),
                threads=sum(_threads(pid) for pid in main),
                processes=len(below),
                disk=0.0 if self.home is None else size(self.home),
            )
        )

    def _find_learner(self, below: Sequence[int]) -> int | None:
        """Return the learner: the first large descendant of the service, as no job is queued before it starts."""
        if self._learner not in below:
            large = [pid for pid in below if (resident_mib(pid) or 0.0) > LEARNER_MIB]
            self._learner = large[0] if large else None
        return self._learner


def _descriptors(pid: int) -> int:
    try:
        return len(os.listdir(PROC / str(pid) / "fd"))
    except OSError:  # the process has ended
        return 0


def _threads(pid: int) -> int:
    try:
        return len(os.listdir(PROC / str(pid) / "task"))
    except OSError:
        return 0


def size(folder: Path) -> float:
    """Return the disk space of a folder, MiB."""
    blocks = 0
    for place, folders, files in os.walk(folder):  # skips folders deleted meanwhile
        for name in (*folders, *files):
            with suppress(FileNotFoundError):
                blocks += os.lstat(os.path.join(place, name)).st_blocks
    return blocks * 512 / (1 << 20)


def series(looks: Sequence[Look], name: str) -> list[float]:
    """Return one figure of all looks."""
    return [float(asdict(look)[name]) for look in looks]


@dataclass(frozen=True)
class Growth:
    """Growth of a figure after the first tenth of a run, by linear regression; level: at the start of the line."""

    level: float
    rise: float

    @property
    def share(self) -> float:
        """Rise over level; 0 if the level is 0."""
        return self.rise / self.level if self.level > 0 else 0.0


def growth(looks: Sequence[float], at: Sequence[float] | None = None) -> Growth | None:
    """Return the line through the medians of all blocks after the first tenth; None for too few looks.

    `at` holds the times of the looks; None: equal distances.
    """
    times = np.arange(len(looks), dtype=float) if at is None else np.asarray(at, dtype=float)
    if len(times) < 2 * BLOCKS or times[-1] <= times[0]:
        return None
    share = (times - times[0]) / (times[-1] - times[0])
    part = np.floor(BLOCKS * (share - WARM_UP_SHARE) / (1 - WARM_UP_SHARE)).astype(int).clip(max=BLOCKS - 1)
    known = sorted(set(part[part >= 0].tolist()))
    medians = [float(np.median(np.asarray(looks)[part == number])) for number in known]
    slope, start = np.polyfit((np.array(known) + 0.5) / BLOCKS, medians, 1)
    return Growth(float(start), float(slope))

"""Memory of the service while it is under load. Linux only."""

from __future__ import annotations

import re
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from service.bench.processor import PROC

PERIOD = 1.0


class MemoryWatch:
    """Looks once a second, in a thread of its own, while it is entered.

    service, children: MiB at each look, of the service's own process and of those below it; empty where the system does
    not tell. Memory that processes share counts once, in parts (PSS).
    """

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.service: list[float] = []
        self.children: list[float] = []
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def _watch(self) -> None:
        began = time.monotonic()
        while not self._end.wait(max(0.0, began + PERIOD * len(self.service) - time.monotonic())):
            own = _mib(self.pid)
            if own is None:
                return
            self.service.append(own)
            self.children.append(sum(_mib(child) or 0.0 for child in _children(self.pid)))

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end.set()
        self._thread.join()


def growth(looks: list[float]) -> float | None:
    """By which share the median of the last quarter exceeds that of the second; None for too few looks.

    The first quarter is left out: caches fill, and the learner process starts.
    """
    quarter = len(looks) // 4
    if quarter < 2:
        return None
    before, after = looks[quarter : 2 * quarter], looks[-quarter:]
    return float(np.median(after) / np.median(before) - 1)


def _mib(pid: int) -> float | None:
    try:
        text = (PROC / str(pid) / "smaps_rollup").read_text()
    except OSError:
        return None
    found = re.search(r"^Pss:\s+(\d+) kB", text, re.MULTILINE)
    return None if found is None else int(found.group(1)) / 1024


def _children(pid: int) -> list[int]:
    found = []
    for path in PROC.glob("[0-9]*/stat"):
        try:
            parent = int(Path(path).read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
        if parent == pid:
            found.append(int(path.parent.name))
    return found

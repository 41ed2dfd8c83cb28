"""Processes as the system tells of them: whose children they are, and how much memory they have. Linux only.

Elsewhere nothing is found, and what would be measured is said to be unknown.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

PROC = Path("/proc")
_PARENT = 1


def stats() -> Iterator[tuple[int, list[str]]]:
    """Every process: its id and the fields of /proc/PID/stat after its name."""
    for path in PROC.glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
            continue
        yield int(path.parent.name), fields


def levels(pid: int, known: Mapping[int, list[str]] | None = None) -> list[list[int]]:
    """A process, then its children, then theirs, and so on. known: what `stats` found, looked up where None."""
    children: dict[int, list[int]] = {}
    for child, fields in stats() if known is None else known.items():
        children.setdefault(int(fields[_PARENT]), []).append(child)
    found = [[pid]]
    while below := [child for parent in found[-1] for child in children.get(parent, [])]:
        found.append(below)
    return found


def resident(pid: int, name: str = "VmRSS") -> float | None:
    """Resident memory of a process, MiB: VmRSS now, VmHWM the most since it started; None where it has ended."""
    return _figure(pid, "status", name)


def written(pid: int) -> float | None:
    """Memory that a process has written, MiB, where what n processes share counts an n-th; None where it has ended.

    Without what is mapped of files: its share changes with every other process on the machine that maps the same
    libraries, and the system drops it when it needs the room.
    """
    return _figure(pid, "smaps_rollup", "Pss_Anon", "Pss_Shmem")


class Watch:
    """Calls `look` in a thread of its own, once a period of so many seconds, while it is entered; then raises the error
    that `look` may have ended with."""

    def __init__(self, period: float, look: Callable[[], None]) -> None:
        self.period, self.look = period, look
        self._end = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def _watch(self) -> None:
        due = time.monotonic()
        try:
            while not self._end.wait(max(0.0, due - time.monotonic())):
                self.look()
                due += self.period
        except Exception as error:
            self._error = error

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end.set()
        self._thread.join()
        if self._error is not None and error is None:
            raise self._error


def _figure(pid: int, file: str, *names: str) -> float | None:
    """Sum of what a file below /proc/PID says under these names, MiB; None where it does not say all of them."""
    try:
        text = (PROC / str(pid) / file).read_text()
    except OSError:
        return None
    found = re.findall(rf"^(?:{'|'.join(names)}):\s+(\d+) kB", text, re.MULTILINE)
    return sum(map(int, found)) / 1024 if len(found) == len(names) else None

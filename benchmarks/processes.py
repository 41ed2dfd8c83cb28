"""Process trees and memory, read from /proc. On systems other than Linux nothing is found."""

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
    """Yield id and fields of /proc/PID/stat, after the name, of every process."""
    for path in PROC.glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):  # the process has ended
            continue
        yield int(path.parent.name), fields


def levels(pid: int, known: Mapping[int, list[str]] | None = None) -> list[list[int]]:
    """Return a process, its children, their children and so on, a list each; known: the result of `stats`, if read."""
    children: dict[int, list[int]] = {}
    for child, fields in stats() if known is None else known.items():
        children.setdefault(int(fields[_PARENT]), []).append(child)
    found = [[pid]]
    while below := [child for parent in found[-1] for child in children.get(parent, [])]:
        found.append(below)
    return found


def resident_mib(pid: int, name: str = "VmRSS") -> float | None:
    """Return resident memory of a process (VmRSS: now, VmHWM: its peak); None if the process has ended."""
    return _figure(pid, "status", name)


def written_mib(pid: int) -> float | None:
    """Return memory that a process has written; None if the process has ended.

    A page that n processes share counts as 1/n. Mapped files do not count: their share depends on all processes that
    map the same libraries, and the system can drop them.
    """
    return _figure(pid, "smaps_rollup", "Pss_Anon", "Pss_Shmem")


class PeriodicCall:
    """A context manager that calls `function` every `period` seconds in a thread, and raises its error on exit."""

    def __init__(self, period: float, function: Callable[[], None]) -> None:
        self.period, self.function = period, function
        self._end = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def _watch(self) -> None:
        due = time.monotonic()
        try:
            while not self._end.wait(max(0.0, due - time.monotonic())):
                self.function()
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
    """Return the sum of these entries of a file below /proc/PID, MiB; None if one is missing."""
    try:
        text = (PROC / str(pid) / file).read_text()
    except OSError:
        return None
    found = re.findall(rf"^(?:{'|'.join(names)}):\s+(\d+) kB", text, re.MULTILINE)
    return sum(map(int, found)) / 1024 if len(found) == len(names) else None

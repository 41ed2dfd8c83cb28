"""Records the changes of files that programs make below one folder, in order, with marks of the test.

The recorder is `watch.c`, which is preloaded into the programs and their children.
"""

from __future__ import annotations

import json
import mmap
import os
import shutil
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import pytest

SOURCE = Path(__file__).with_name("watch.c")
HEADER = struct.Struct("=IIQQII")
STATE, CHOSEN = 4096, struct.Struct("=128sQQQ")
"""Size of the memory that the processes share, and its part that selects the fsyncs to fail, at byte 512."""
CHOSEN_AT = 512

needs_compiler = pytest.mark.skipif(
    sys.platform != "linux" or shutil.which("cc") is None, reason="needs Linux and a C compiler, cc"
)


class Kind(IntEnum):
    """Kind of a record; the numbers are those of `watch.c`. MARK: written by the test."""

    CREATE, WRITE, RESIZE, RENAME, UNLINK, MKDIR, RMDIR, SYNC, FAILED, UNKNOWN, MARK = range(1, 12)


@dataclass(frozen=True)
class Record:
    """One change. path: empty for a file without a name; other: the new name of a renamed file; inode: 0 for a
    folder; at: offset of a write, or the new size."""

    kind: Kind
    path: str
    other: str = ""
    inode: int = 0
    at: int = 0
    data: bytes = b""

    @property
    def mark(self) -> dict[str, Any]:
        """The content of a mark."""
        facts: dict[str, Any] = json.loads(self.data)
        return facts


@cache
def compile_library() -> Path:
    """Compile `watch.c`, once per process; return the path of the library."""
    path = Path(mkdtemp(prefix="lipserve-power-")) / "watch.so"
    arguments = [
        "cc",
        "-O2",
        "-shared",
        "-fPIC",
        "-fvisibility=hidden",
        "-o",
        str(path),
        str(SOURCE),
        "-ldl",
        "-lpthread",
    ]
    subprocess.run(arguments, check=True)
    return path


class Recording:
    """Records what programs that are started with `environment` do below `root`.

    home: the home of the service, below `root`.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self.root = (folder / "root").resolve()
        self.root.mkdir()
        self.home, self.log, self._state = self.root / "home", folder / "records", folder / "state"
        self.log.touch()
        self._state.write_bytes(bytes(STATE))
        self._marks = os.open(self.log, os.O_WRONLY | os.O_APPEND)
        self.before: list[tuple[str, int, bytes | None]] = []

    def record_initial_state(self) -> None:
        """Record what exists as stored on the disk: paths, inodes and contents; None for folders."""
        for path in sorted(self.root.rglob("*")):
            self.before.append((str(path), path.stat().st_ino, None if path.is_dir() else path.read_bytes()))

    @property
    def environment(self) -> dict[str, str]:
        """Environment variables for the recorded programs."""
        return {
            "LD_PRELOAD": str(compile_library()),
            "POWER_ROOT": str(self.root),
            "POWER_LOG": str(self.log),
            "POWER_STATE": str(self._state),
        }

    def mark(self, **facts: Any) -> None:
        """Append a mark after everything recorded so far."""
        data = json.dumps(facts).encode()
        os.write(self._marks, HEADER.pack(Kind.MARK, len(data), 0, 0, 0, 0) + data)

    def fail_syncs(self, pattern: str, skip: int = 0, count: int = 1) -> None:
        """Make `count` fsyncs fail of paths that match a pattern, after skipping `skip` of them."""
        self._choose(CHOSEN.pack(pattern.encode(), skip, count, 0))

    def count_failed_syncs(self) -> int:
        """Return how many of the selected fsyncs have failed."""
        with self._state.open("rb") as file:
            file.seek(CHOSEN_AT)
            return CHOSEN.unpack(file.read(CHOSEN.size))[-1]

    def _choose(self, chosen: bytes) -> None:
        with self._state.open("r+b") as file, mmap.mmap(file.fileno(), STATE) as shared:
            shared[CHOSEN_AT : CHOSEN_AT + len(chosen)] = chosen

    def records(self) -> Iterator[Record]:
        """Yield the records in order."""
        with self.log.open("rb") as file:
            while header := file.read(HEADER.size):
                kind, size, inode, at, first, second = HEADER.unpack(header)
                path, other = (file.read(each).decode() for each in (first, second))
                data = file.read(size)
                assert len(data) == size, "the last record is cut off"
                paths = [each and os.path.normpath(each) for each in (path, other)]
                yield Record(Kind(kind), *paths, inode, at, data)

"""Programs whose changes of files below one folder are written down, in one order, with what clients were told.

The work is done by `watch.c`, which is preloaded into them and their children.
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
"""Bytes that the processes share; which fsyncs fail, from byte 512 on."""
CHOSEN_AT = 512

needs_compiler = pytest.mark.skipif(
    sys.platform != "linux" or shutil.which("cc") is None, reason="needs Linux and a C compiler, cc"
)


class Kind(IntEnum):
    """What was done; the numbers are those of `watch.c`. MARK: written by a test, which was told something."""

    CREATE, WRITE, RESIZE, RENAME, UNLINK, MKDIR, RMDIR, SYNC, FAILED, UNKNOWN, MARK = range(1, 12)


@dataclass(frozen=True)
class Record:
    """One change. path: empty where a file has no name; other: the new name of what is renamed; inode: of the file, 0
    where it is a folder; at: byte of a write, or the new size."""

    kind: Kind
    path: str
    other: str = ""
    inode: int = 0
    at: int = 0
    data: bytes = b""

    @property
    def mark(self) -> dict[str, Any]:
        """What a test has written."""
        told: dict[str, Any] = json.loads(self.data)
        return told


@cache
def library() -> Path:
    """The compiled `watch.c`, for as long as this process lives."""
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
    """What programs do below a folder that are started with `environment`; the folder has to be there.

    home: what they work on, below `root`, which is watched.
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

    def begin(self) -> None:
        """Note what is there, all of it on the disk for sure: paths, inodes and contents, None of a folder."""
        for path in sorted(self.root.rglob("*")):
            self.before.append((str(path), path.stat().st_ino, None if path.is_dir() else path.read_bytes()))

    @property
    def environment(self) -> dict[str, str]:
        """Variables that a program has to be started with."""
        return {
            "LD_PRELOAD": str(library()),
            "POWER_ROOT": str(self.root),
            "POWER_LOG": str(self.log),
            "POWER_STATE": str(self._state),
        }

    def mark(self, **told: Any) -> None:
        """Write down what a client asks for, or was told: all that was recorded before has happened before."""
        data = json.dumps(told).encode()
        os.write(self._marks, HEADER.pack(Kind.MARK, len(data), 0, 0, 0, 0) + data)

    def fail(self, pattern: str, skip: int = 0, count: int = 1) -> None:
        """Let `count` fsyncs fail of files and folders whose paths are like a pattern, after the first `skip`."""
        self._choose(CHOSEN.pack(pattern.encode(), skip, count, 0))

    def failed(self) -> int:
        """How many fsyncs have failed since they were chosen."""
        with self._state.open("rb") as file:
            file.seek(CHOSEN_AT)
            return CHOSEN.unpack(file.read(CHOSEN.size))[-1]

    def _choose(self, chosen: bytes) -> None:
        with self._state.open("r+b") as file, mmap.mmap(file.fileno(), STATE) as shared:
            shared[CHOSEN_AT : CHOSEN_AT + len(chosen)] = chosen

    def records(self) -> Iterator[Record]:
        """What has been recorded, in order."""
        with self.log.open("rb") as file:
            while header := file.read(HEADER.size):
                kind, size, inode, at, first, second = HEADER.unpack(header)
                path, other = (file.read(each).decode() for each in (first, second))
                data = file.read(size)
                assert len(data) == size, "the last record is cut off"
                paths = [each and os.path.normpath(each) for each in (path, other)]
                yield Record(Kind(kind), *paths, inode, at, data)

"""A wall clock of a service's own, which a test sets while the service runs."""

from __future__ import annotations

import shutil
import subprocess
from functools import cache
from pathlib import Path
from struct import pack
from tempfile import mkdtemp

SOURCE = Path(__file__).with_name("clock.c")
COMPILER = shutil.which("cc")


@cache
def _library() -> Path:
    """The compiled library, once a process."""
    assert COMPILER is not None
    path = Path(mkdtemp(prefix="lipserve-clock-")) / "clock.so"
    subprocess.run([COMPILER, "-O1", "-shared", "-fPIC", "-o", str(path), str(SOURCE), "-ldl", "-lm"], check=True)
    return path


class Clock:
    """Of one service, also over its restarts. file: with the seconds by which it differs from the machine's.

    Where there is no C compiler it cannot be set, and `movable` is false.
    """

    movable = COMPILER is not None

    def __init__(self, file: Path) -> None:
        self.file = file
        self.set(0.0)

    def set(self, seconds: float) -> None:
        """Let it show so many seconds more than the machine's, at once."""
        with self.file.open("r+b" if self.file.exists() else "wb") as file:  # in place: it is mapped
            file.write(pack("=d", seconds))

    @property
    def environment(self) -> dict[str, str]:
        """Of a process that goes by it, and of all that this one starts."""
        return {"LD_PRELOAD": str(_library()), "CLOCK_OFFSET_FILE": str(self.file)} if self.movable else {}

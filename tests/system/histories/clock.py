"""A wall clock for one service, which a test can set or advance while the service runs."""

from __future__ import annotations

import shutil
import subprocess
import time
from functools import cache
from pathlib import Path
from struct import pack
from tempfile import mkdtemp

SOURCE = Path(__file__).with_name("clock.c")
COMPILER = shutil.which("cc")


@cache
def _compile_library() -> Path:
    """Compile the library, once per process."""
    assert COMPILER is not None
    path = Path(mkdtemp(prefix="lipserve-clock-")) / "clock.so"
    subprocess.run([COMPILER, "-O1", "-shared", "-fPIC", "-o", str(path), str(SOURCE), "-ldl", "-lm"], check=True)
    return path


class Clock:
    """The clock of one service, also after its restarts. file: contains the seconds by which the clock was set, and
    those that the machine has slept.

    Without a C compiler the clock cannot be set, and `movable` is false.
    """

    movable = COMPILER is not None

    def __init__(self, file: Path) -> None:
        self.file, self.slept = file, 0.0
        self.set(0.0)

    def set(self, seconds: float) -> None:
        """Set the offset from the right time in seconds, with immediate effect."""
        self._offset = seconds
        self._write()

    def sleep(self, seconds: float) -> None:
        """Let time pass as while the machine sleeps: all clocks advance but the monotonic one."""
        self.slept += seconds
        self._write()

    def now(self) -> float:
        """Return the right time, Unix time, s."""
        return time.time() + self.slept

    def _write(self) -> None:
        with self.file.open("r+b" if self.file.exists() else "wb") as file:  # in place, because it is mapped
            file.write(pack("=2d", self._offset, self.slept))

    @property
    def environment(self) -> dict[str, str]:
        """Environment variables of a process that uses this clock, and of its children."""
        return {"LD_PRELOAD": str(_compile_library()), "CLOCK_OFFSET_FILE": str(self.file)} if self.movable else {}

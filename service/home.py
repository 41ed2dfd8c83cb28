"""The home folder belongs to one running service at a time."""

from __future__ import annotations

import fcntl
from pathlib import Path
from typing import IO


class HomeInUseError(RuntimeError):
    """Another service works on the same home."""


def hold_home(home: Path) -> IO[str]:
    """Hold the home for this process; the lock ends with the process, however it ends."""
    home.mkdir(parents=True, exist_ok=True)
    file = (home / ".lock").open("w")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise HomeInUseError(f"another service uses {home}: stop it, or set LIPSERVE_HOME to another folder") from None
    return file

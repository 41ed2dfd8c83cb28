"""Names of files that outlive a power cut: a file that is synced may still be lost with its name, which is kept by its
folder, and a folder with its name in the folder above."""

from __future__ import annotations

import os
from pathlib import Path


def sync(folder: Path) -> None:
    """Have the names in a folder on the disk; raise OSError."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def make_folder(folder: Path, mode: int = 0o777) -> None:
    """Make a folder of this mode, and those above it that are missing; where it is there, see that its name is on the
    disk: who has made it may have ended before. Raise OSError."""
    if not folder.parent.is_dir():
        make_folder(folder.parent)
    made = not folder.is_dir()
    folder.mkdir(mode, exist_ok=True)
    try:
        sync(folder.parent)
    except PermissionError:  # somebody else has made it, where this user may not look
        if made:
            raise

"""File names that survive a power cut: a synced file may still be lost if the name in its folder is not synced."""

from __future__ import annotations

import os
from pathlib import Path


def sync_folder(folder: Path) -> None:
    """Write the names in a folder to the disk; raise OSError."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def make_folder(folder: Path, mode: int = 0o777) -> None:
    """Make a folder with this mode and its missing parents, and sync its name; raise OSError.

    The name of an existing folder is synced, too: the process that made it may have ended before.
    """
    if not folder.parent.is_dir():
        make_folder(folder.parent)
    made = not folder.is_dir()
    folder.mkdir(mode, exist_ok=True)
    try:
        sync_folder(folder.parent)
    except PermissionError:  # another user made it in a folder that this user cannot open
        if made:
            raise

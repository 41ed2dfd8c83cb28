"""Writing a file so that it outlives a power cut, and telling whether it is still what was written."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import IO, TypeVar

from service.storage import sample_file

Result = TypeVar("Result")


class DamagedFileError(ValueError):
    """A file does not have the sha256 that was kept of it, or is not there."""


def check(path: Path, sha256: str) -> None:
    """Raise DamagedFileError unless a file is there and has this sha256."""
    try:
        digest = sample_file.sha256(path)
    except FileNotFoundError:
        raise DamagedFileError(f"{path} is missing") from None
    if digest != sha256:
        raise DamagedFileError(f"{path} does not have the sha256 that was kept of it")


def store(path: Path, write: Callable[[IO[bytes]], Result], draft: Path | None = None) -> Result:
    """Write a file that outlives a power cut, whole or not at all; return what `write` does.

    draft: what it is called until it is whole; beside it by default.
    """
    draft = path.with_suffix(".draft") if draft is None else draft
    try:
        with draft.open("wb") as file:
            result = write(file)
            file.flush()
            os.fsync(file.fileno())
        draft.rename(path)
    except (OSError, ValueError):
        draft.unlink(missing_ok=True)  # on a full disk, room for what comes next
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # the new name, before a row tells of it
    finally:
        os.close(folder)
    return result

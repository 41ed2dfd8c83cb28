"""Functions that damage a file."""

import os
from collections.abc import Callable
from pathlib import Path


def flip(path: Path) -> None:
    """Flip a bit in the middle."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def cut(path: Path) -> None:
    """Cut off the second half."""
    os.truncate(path, path.stat().st_size // 2)


def empty(path: Path) -> None:
    """Remove the content, as file systems do after a power cut."""
    os.truncate(path, 0)


def zero(path: Path) -> None:
    """Overwrite the second half with zeros."""
    size = path.stat().st_size
    cut(path)
    os.truncate(path, size)


def remove(path: Path) -> None:
    """Delete the file."""
    path.unlink()


HARM: tuple[Callable[[Path], None], ...] = (flip, cut, empty, zero, remove)

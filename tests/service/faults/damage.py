"""Ways in which a file comes to harm."""

import os
from collections.abc import Callable
from pathlib import Path


def flip(path: Path) -> None:
    """A bit in the middle has turned."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def cut(path: Path) -> None:
    """The second half is missing."""
    os.truncate(path, path.stat().st_size // 2)


def empty(path: Path) -> None:
    """Nothing is left, as file systems leave files after a power cut."""
    os.truncate(path, 0)


def zero(path: Path) -> None:
    """The second half are zeros."""
    size = path.stat().st_size
    cut(path)
    os.truncate(path, size)


def remove(path: Path) -> None:
    """It is gone."""
    path.unlink()


HARM: tuple[Callable[[Path], None], ...] = (flip, cut, empty, zero, remove)

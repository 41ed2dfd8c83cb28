"""What every format is read as: named columns of numbers, block after block; and what all formats do alike for that."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from lipcore.data.samples import Array
from service.foundation.errors import invalid_data

BLOCK_ROWS = 16_384
"""Most rows of a block: what is held in memory of a file, however long it is."""
SAME_LENGTH = 0.9
"""Share of a list's rows that must be of one length: then another is an error, else the list is of no fixed shape."""
MAX_COLUMNS = 2000
"""Columns of a recording's file, lists taken apart."""


@dataclass
class Table:
    """A recording as its file holds it; to be read once, while the file is open.

    names: of the columns, as the file has them; blocks: float64 (rows, columns), 1 to BLOCK_ROWS rows each, NaN where a
    value is missing; joint_names: of joints 1..n, where the file says them apart from its columns; units: of columns by
    name, where the file says them; facts: what was noticed on the way, one sentence each, complete once the blocks are
    read.
    """

    names: tuple[str, ...]
    blocks: Iterator[Array]
    joint_names: tuple[str, ...] | None = None
    units: dict[str, str] = field(default_factory=dict)
    facts: list[str] = field(default_factory=list)


def block_rows(columns: int) -> int:
    """Rows of a block of so many columns, 1 to BLOCK_ROWS."""
    return max(1, min(BLOCK_ROWS, 2**24 // (8 * max(columns, 1))))  # at most 16 MiB


def checked_names(names: Iterable[str]) -> tuple[str, ...]:
    """The names of columns, stripped; raise InvalidDataError for one that is doubled or cannot be shown."""
    checked: dict[str, int] = {}
    for index, given in enumerate(names, start=1):
        name = given.strip() or f"unnamed {index}"
        if not name.isprintable():
            raise invalid_data(f"column {index}", name, "a name of printable characters")
        if name in checked:
            raise invalid_data(f"column {index}", name, "every column once")
        checked[name] = index
    if len(checked) > MAX_COLUMNS:
        raise invalid_data("columns", len(checked), f"at most {MAX_COLUMNS}")
    return tuple(checked)


def stacked(columns: Sequence[Array]) -> Iterator[Array]:
    """Columns of equal length (rows,) as blocks (≤ block_rows, columns)."""
    rows, step = len(columns[0]), block_rows(len(columns))
    for start in range(0, rows, step):
        yield np.column_stack([each[start : start + step] for each in columns])


_ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+")


def first_line(error: BaseException) -> str:
    """The first line of an error's message, its type where it has none; without addresses of objects in memory."""
    return _ADDRESS.sub("", (str(error).strip() or type(error).__name__).splitlines()[0])


def left_out(names: Sequence[str], reason: str) -> list[str]:
    """The fact that columns are left out, as a list of one sentence or none; long lists are cut."""
    if not names:
        return []
    listed = ", ".join(names[:10]) + (f" and {len(names) - 10} more" if len(names) > 10 else "")
    return [f"left out, as {reason}: {listed}"]

"""The table that every format is read as: named columns of numbers, in blocks; and helpers that all readers share."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from lipcore.data.samples import Array
from service.foundation.errors import InvalidDataError, invalid_data, readable

BLOCK_ROWS = 16_384
"""Max rows of a block. A reader holds one block in memory, however long the file is."""
SAME_LENGTH = 0.9
"""Min share of rows in which a list has its usual length. Then other lengths are errors, else the list is ignored."""
MAX_COLUMNS = 2000
"""Max columns of a file, with lists split into their elements."""


@dataclass
class Table:
    """The contents of a recording's file. The blocks can be read once, while the file is open."""

    names: tuple[str, ...]
    """Column names as in the file."""
    blocks: Iterator[Array]
    """float64 (rows, columns), 1 to BLOCK_ROWS rows each; NaN if a value is missing."""
    joint_names: tuple[str, ...] | None = None
    """Names of joints 1..n, if the file lists them separately from its columns."""
    units: dict[str, str] = field(default_factory=dict)
    """Units by column name, if the file states them."""
    facts: list[str] = field(default_factory=list)
    """Sentences for the report; complete after the blocks are read."""


def block_rows(columns: int) -> int:
    """Return the number of rows of a block, 1 to BLOCK_ROWS."""
    return max(1, min(BLOCK_ROWS, 2**24 // (8 * max(columns, 1))))  # at most 16 MiB


def clean_names(names: Iterable[str]) -> tuple[str, ...]:
    """Return the column names, stripped; raise InvalidDataError if one is repeated or not printable."""
    checked: dict[str, int] = {}
    for index, given in enumerate(names, start=1):
        name = given.strip() or f"unnamed {index}"
        if not name.isprintable():
            raise invalid_data(f"column {index}", name, "a name of printable characters")
        if name in checked:
            raise invalid_data(f"column {index}", name, "each column only once")
        checked[name] = index
    if len(checked) > MAX_COLUMNS:
        raise invalid_data("columns", len(checked), f"at most {MAX_COLUMNS}")
    return tuple(checked)


def name_columns(names: Sequence[str], width: int) -> tuple[str, ...]:
    """Return the names of the option `column_names`; raise InvalidDataError if there are not `width`."""
    if len(names) != width:
        expected = f"{width} names because the rows have {width} values"
        raise invalid_data("column_names", f"{len(names)} names", expected)
    return tuple(names)


def stack_blocks(columns: Sequence[Array]) -> Iterator[Array]:
    """Yield columns of equal length (rows,) as blocks (≤ block_rows, columns)."""
    rows, step = len(columns[0]), block_rows(len(columns))
    for start in range(0, rows, step):
        yield np.column_stack([each[start : start + step] for each in columns])


_ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+")


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, or its type if it has none, without memory addresses."""
    return _ADDRESS.sub("", (str(error).strip() or type(error).__name__).splitlines()[0])


def describe_unread(names: Sequence[str], reason: str) -> list[str]:
    """Return a list of one sentence about columns that are not read, or an empty list; long lists are cut."""
    if not names:
        return []
    listed = ", ".join(names[:10]) + (f" and {len(names) - 10} more" if len(names) > 10 else "")
    return [f"not read because {reason}: {listed}"]


def unreadable(field: str, reason: str, expected: str) -> InvalidDataError:
    """Return the error for a file, or a part of it, that a library could not read."""
    what = "The file" if field == "file" else readable(field[:200])
    return invalid_data(field, reason, expected, f"{what} could not be read: {readable(reason[:200])}")

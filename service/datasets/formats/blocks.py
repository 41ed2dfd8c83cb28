"""What every format does alike: bounded blocks, names that can be told apart, errors of a library put in our words."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from lipcore.data.samples import Array
from service.datasets.formats.table import BLOCK_ROWS
from service.foundation.errors import invalid_data
from service.foundation.settings import Settings

BLOCK_BYTES = 16 * 1024 * 1024
"""Largest block: a file of many columns is read fewer rows at a time."""


def block_rows(columns: int) -> int:
    """Rows of a block of so many columns, 1 to BLOCK_ROWS."""
    return max(1, min(BLOCK_ROWS, BLOCK_BYTES // (8 * max(columns, 1))))


def checked_names(names: Iterable[str], settings: Settings) -> tuple[str, ...]:
    """The names of columns, stripped; raise InvalidDataError for one that is doubled or cannot be shown."""
    seen: dict[str, int] = {}
    for index, said in enumerate(names, start=1):
        name = said.strip() or f"unnamed {index}"
        if not name.isprintable():
            raise invalid_data(f"column {index}", name, "a name of printable characters")
        if name in seen:
            raise invalid_data(f"column {index}", name, "every column once")
        seen[name] = index
    if len(seen) > settings.max_columns:
        raise invalid_data("columns", len(seen), f"at most {settings.max_columns}")
    return tuple(seen)


def stacked(columns: Sequence[Array]) -> Iterator[Array]:
    """Columns of equal length (rows,) as blocks (≤ block_rows, columns)."""
    rows, step = len(columns[0]), block_rows(len(columns))
    for start in range(0, rows, step):
        yield np.column_stack([each[start : start + step] for each in columns])


def guarded(
    blocks: Iterator[Array], errors: tuple[type[BaseException], ...], expected: str, field: str = "file"
) -> Iterator[Array]:
    """The same blocks; an error of the library that reads them becomes an InvalidDataError.

    Only reading is guarded: an error of the one who takes the blocks stays what it is.
    """
    while True:
        try:
            block = next(blocks)
        except StopIteration:
            return
        except errors as error:
            raise invalid_data(field, said(error), expected) from None
        yield block


def said(error: BaseException) -> str:
    """The first line of an error's message, its type where it has none."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def left_out(names: Sequence[str], reason: str) -> list[str]:
    """The fact that columns are left out, as a list of one sentence or none; long lists are cut."""
    if not names:
        return []
    shown = ", ".join(names[:10]) + (f" and {len(names) - 10} more" if len(names) > 10 else "")
    return [f"left out, as {reason}: {shown}"]

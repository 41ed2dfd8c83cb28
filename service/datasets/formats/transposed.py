"""Reading transposed tables of text: each row is a name and its numbers."""

from __future__ import annotations

import csv
from itertools import islice
from pathlib import Path

import pyarrow as pa

from service.datasets.formats.cells import NumberCells
from service.datasets.formats.table import MAX_COLUMNS, Table, clean_names, stack_blocks, unreadable
from service.datasets.formats.text import TextLayout, split_rows
from service.foundation.errors import TooLargeError, invalid_data

MAX_BYTES = 64 * 1024 * 1024
"""Max size of such a file, because it is read as a whole."""


def open_transposed(path: Path, layout: TextLayout) -> Table:
    """Read a transposed table; raise InvalidDataError that names the row of an error, or TooLargeError."""
    if (size := path.stat().st_size) > MAX_BYTES:
        raise TooLargeError(
            f"The transposed table has {size} bytes, expected at most {MAX_BYTES}. Store a row per time."
        )
    with path.open(encoding=layout.encoding, newline="") as file:
        lines = islice(file, layout.header.lines, layout.header.lines + MAX_COLUMNS + 1)
        try:
            rows = [cells for cells, _ in split_rows(lines, layout.delimiter, layout.quote) if cells]
        except csv.Error as error:
            raise unreadable("file", str(error), "rows of a name and its numbers") from None
    names = clean_names([cells[0] for cells in rows])
    for name, cells in zip(names, rows, strict=True):
        if len(cells) != len(rows[0]):
            raise invalid_data(f"row {name}", f"{len(cells)} values", f"{len(rows[0])} values, as in row {names[0]}")
    numbers = [
        NumberCells(name, layout.delimiter != ",").read(pa.array(cells[1:], pa.string()), 1)[0]
        for name, cells in zip(names, rows, strict=True)
    ]
    return Table(
        names, stack_blocks(numbers), facts=[*layout.facts, *layout.header.facts, "each row of the file is a column"]
    )

"""Reading CSV and its kin: a line of column names, then numbers, separated by whatever separates them."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import pyarrow as pa
import pyarrow.csv as pacsv

from lipcore.data.samples import Array
from service.datasets.formats.blocks import checked_names, left_out, said, stacked
from service.datasets.formats.cells import MISSING, NumberColumn, StampColumn
from service.datasets.formats.csv_header import BLANK, Header, not_utf8, read_header
from service.datasets.formats.table import Table
from service.datasets.options import ReadOptions
from service.foundation.errors import invalid_data
from service.foundation.settings import Settings

LINE_BYTES = 1024 * 1024
"""Longest line, and how much of a file is parsed at a time."""
_NAMES = {";": "semicolons", "\t": "tabs", "|": "bars", BLANK: "blanks"}
"""Delimiters that are worth telling."""


@contextmanager
def open_csv(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open a CSV file as a table; raise InvalidDataError naming row and column of what is wrong.

    Columns of text are left out, which is a fact of the table; an empty cell is a missing value; times as dates become
    seconds since the first.
    """
    header = read_header(path, options.delimiter)
    names = checked_names(header.names, settings)
    with path.open("rb") as file:
        for _ in range(header.lines):
            file.readline()
        batches = _batches(path, _Squeezed(file) if header.delimiter == BLANK else file, header)
        first = next(batches, None)
        if first is None:
            yield Table(names, iter(()))
            return
        columns = _columns(names, first, header)
        readers = {index: each for index, each in enumerate(columns) if each is not None}
        facts = [f"separated by {_NAMES[header.delimiter]}"] if header.delimiter in _NAMES else []
        facts += left_out([name for index, name in enumerate(names) if index not in readers], "they hold no numbers")
        stamps = [each.name for each in readers.values() if isinstance(each, StampColumn)]
        facts += [f"{name} holds dates: read as seconds since its first" for name in stamps]
        kept = tuple(each.name for each in readers.values())
        yield Table(kept, _blocks(first, batches, readers, facts), units=dict.fromkeys(stamps, "s"), facts=facts)


def _blocks(
    first: pa.RecordBatch,
    batches: Iterator[pa.RecordBatch],
    readers: dict[int, NumberColumn | StampColumn],
    facts: list[str],
) -> Iterator[Array]:
    row, batch = 1, first
    while batch is not None and readers:
        yield from stacked([each.read(batch.column(index), row) for index, each in readers.items()])
        row += batch.num_rows
        batch = next(batches, None)
    if any(isinstance(each, NumberColumn) and each.commas for each in readers.values()):
        facts.append("numbers are written with decimal commas")


def _columns(names: tuple[str, ...], batch: pa.RecordBatch, header: Header) -> list[NumberColumn | StampColumn | None]:
    """How each column is read, judged by its first cells; None where most of them are text."""
    found: list[NumberColumn | StampColumn | None] = []
    for name, column in zip(names, batch.columns, strict=True):
        number = NumberColumn(name, decimal_comma=header.delimiter != ",")
        found.append(number if number.share(column) >= 0.5 else StampColumn.of(name, column))
    return found


def _batches(path: Path, file: IO[bytes] | io.RawIOBase, header: Header) -> Iterator[pa.RecordBatch]:
    """The rows as text cells, checked to be as wide as the header."""
    wrong: list[pacsv.InvalidRow] = []

    def note(row: pacsv.InvalidRow) -> str:
        wrong.append(row)
        return "error"

    keys = [str(index) for index in range(len(header.names))]
    try:
        reader = pacsv.open_csv(
            file,
            read_options=pacsv.ReadOptions(use_threads=False, block_size=LINE_BYTES, column_names=keys),
            parse_options=pacsv.ParseOptions(delimiter=header.delimiter, invalid_row_handler=note),
            convert_options=pacsv.ConvertOptions(
                column_types=dict.fromkeys(keys, pa.string()), strings_can_be_null=True, null_values=list(MISSING)
            ),
        )
        for batch in reader:
            if batch.num_rows:
                yield batch
    except (pa.ArrowException, OSError, ValueError) as error:
        text = said(error)
        if "Empty CSV" in text:
            return
        if wrong:
            expected = f"{len(keys)} values, as the header has columns"
            raise invalid_data(f"row {wrong[0].number}", f"{wrong[0].actual_columns} values", expected) from None
        if "UTF8" in text or "UTF-8" in text:
            raise not_utf8(path) from None
        if "straddl" in text:
            raise invalid_data("file", f"a line of more than {LINE_BYTES} bytes", "shorter lines") from None
        raise invalid_data("file", text, f"numbers separated by {_NAMES.get(header.delimiter, 'commas')}") from None


class _Squeezed(io.RawIOBase):
    """A text file whose runs of blanks are one blank each, and none stands at either end of a line."""

    def __init__(self, file: IO[bytes]) -> None:
        self.file, self.rest = file, b""

    def readable(self) -> bool:
        """It is."""
        return True

    def read(self, size: int = -1) -> bytes:
        """Up to `size` bytes of whole lines."""
        while True:
            chunk = self.file.read(max(size - len(self.rest), 1))
            text = self.rest + chunk
            end = text.rfind(b"\n") + 1 if chunk else len(text)
            text, self.rest = text[:end], text[end:]
            if len(self.rest) > LINE_BYTES:
                raise ValueError("a straddling line")
            out = re.sub(rb"[ \t]*\r?\n[ \t]*", b"\n", re.sub(rb"[ \t]+", b" ", text))
            if out.lstrip(b"\n") or not chunk:
                return out.lstrip(b" ")

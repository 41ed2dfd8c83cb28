"""Reading CSV and similar text: a line of column names, then rows of numbers, with any common delimiter."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import pyarrow as pa
import pyarrow.csv as pacsv

from lipcore.data.samples import Array
from service.datasets.formats.arrow import MISSING, NUMBER, NumberColumn, StampColumn
from service.datasets.formats.table import Table, clean_names, describe_unread, first_line, stack_blocks, unreadable
from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError, invalid_data, invalid_request
from service.foundation.settings import Settings

SAMPLE_CHARS = 256 * 1024
MAX_HEADER_CHARS = 64 * 1024
DELIMITERS = (",", ";", "\t", "|")
BLANK = " "
"""The delimiter that stands for any run of blanks and tabs."""
_NUMERIC = re.compile(rf"\s*(?:{NUMBER}|[+-]?(?:nan|inf(?:inity)?)|[+-]?\d+,\d+(?:[eE][+-]?\d+)?)\s*", re.IGNORECASE)
EXPECTED = "column names in the first line, separated by , ; | tabs or blanks"


@dataclass(frozen=True)
class Header:
    """The header of a text file."""

    names: tuple[str, ...]
    delimiter: str
    """One character; BLANK for runs of blanks."""
    lines: int
    """Lines before the first row."""
    nameless: bool = False
    """Whether the names are not in the file."""


Naming = Callable[[int], tuple[str, ...]]
"""Function that returns names for a number of columns; it raises InvalidDataError if it has not as many."""


def read_header(path: Path, delimiter: str | None, naming: Naming | None = None) -> Header:
    """Find the header of a text file; raise InvalidDataError if it has none and `naming` is not given."""
    lines = _first_lines(path)
    comment = None
    for index, line in enumerate(lines):
        text = line.strip()
        if text.startswith(("#", "%")):
            comment = index
        elif text:
            break
    else:
        if comment is None:
            raise invalid_data("header", "empty", "column names in the first line")
        index = comment
    if (longest := max(map(len, lines[: index + 1]))) > MAX_HEADER_CHARS:
        raise invalid_data("header", f"{longest} characters long", f"at most {MAX_HEADER_CHARS}")
    if index != comment and _is_all_numbers(lines[index], delimiter):
        # numpy.savetxt writes the names in the comment above the numbers
        if naming is not None and not _has_names(lines[comment] if comment is not None else "", lines[index]):
            return _header_without_names(lines, index, delimiter, naming)
        if comment is None:
            expected = f"{EXPECTED}. Or set column_names=t,q1..q7,tau1..tau7"
            raise invalid_data("header", _shorten(lines[index]), expected)
        index = comment
    header = lines[index].strip().lstrip("#%") if index == comment else lines[index].strip("\r\n")
    if "\0" in header:
        raise invalid_data("file", "binary", "text in UTF-8")
    rows = _sample_rows(lines, index)
    chosen = _parse_delimiter(delimiter) if delimiter else _choose_delimiter(header, rows)
    names = tuple(name.strip() for name in split_cells(header, chosen))
    if len(names) < 2:
        raise invalid_data("header", _shorten(header), EXPECTED)
    widths = {len(split_cells(row, chosen)) for row in rows}
    if len(rows) > 1 and len(widths) == 1 and widths != {len(names)}:  # otherwise a row is wrong, not the header
        width = widths.pop()
        expected = f"{width} names because each of the first {len(rows)} rows has {width} values"
        raise invalid_data("header", f"{len(names)} names", expected)
    return Header(names, chosen, index + 1)


def _has_names(comment: str, row: str) -> bool:
    """Return whether a comment has as many words as the row below it has numbers."""
    header = comment.strip().lstrip("#%")
    return any(
        1 < len(split_cells(header, each)) == len(split_cells(row.strip(), each)) for each in (*DELIMITERS, BLANK)
    )


def _header_without_names(lines: list[str], index: int, delimiter: str | None, naming: Naming) -> Header:
    """Return the header of a file without names that has that line as its first row of numbers."""
    first = lines[index].strip("\r\n")
    rows = _sample_rows(lines, index)
    chosen = _parse_delimiter(delimiter) if delimiter else _choose_delimiter(first, rows)
    return Header(naming(len(split_cells(first, chosen))), chosen, index, nameless=True)


def _sample_rows(lines: list[str], index: int) -> list[str]:
    """Return the first rows below a line, without empty and very long ones."""
    return [line for line in lines[index + 1 : index + 51] if line.strip() and len(line) <= MAX_HEADER_CHARS]


def _name_from_option(names: tuple[str, ...]) -> Naming:
    """Return the function that gives the names of the option `column_names`."""

    def naming(width: int) -> tuple[str, ...]:
        if len(names) != width:
            expected = f"{width} names because the rows have {width} values"
            raise invalid_data("column_names", f"{len(names)} names", expected)
        return names

    return naming


def split_cells(line: str, delimiter: str) -> list[str]:
    """Split a line into cells without quotes; raise InvalidDataError if it cannot be split."""
    if delimiter == BLANK:
        return [cell.strip('"') for cell in line.split()]
    try:
        return next(csv.reader([line.strip("\r\n")], delimiter=delimiter), [])
    except csv.Error as error:
        raise invalid_data("header", str(error), EXPECTED) from None


def utf8_error(path: Path) -> InvalidDataError:
    """Return the error for a file that is not UTF-8 text, with its first wrong byte."""
    with path.open(encoding="utf-8") as file:
        try:
            while file.read(SAMPLE_CHARS):
                pass
        except UnicodeDecodeError as error:
            return _byte_error(error)
    return invalid_data("file", "not text", "text in UTF-8")


def _byte_error(error: UnicodeDecodeError) -> InvalidDataError:
    byte = f"byte {error.object[error.start]:#04x}"
    return invalid_data("file", byte, "text in UTF-8", f"The file is not text in UTF-8: it contains {byte}.")


def _first_lines(path: Path) -> list[str]:
    """Return the lines at the start of a file, without the last one if it may be incomplete."""
    with path.open(encoding="utf-8-sig", newline="") as file:
        try:
            text = file.read(SAMPLE_CHARS)
        except UnicodeDecodeError as error:
            raise _byte_error(error) from None
    lines = text.split("\n")
    return lines[:-1] if len(text) == SAMPLE_CHARS and len(lines) > 1 else lines


def _is_all_numbers(line: str, delimiter: str | None) -> bool:
    candidates = (_parse_delimiter(delimiter),) if delimiter else (*DELIMITERS, BLANK)
    for candidate in candidates:
        filled = [cell for cell in split_cells(line, candidate) if cell.strip()]
        if filled and all(_NUMERIC.fullmatch(cell) for cell in filled):
            return True
    return False


def _choose_delimiter(header: str, rows: list[str]) -> str:
    """Return the delimiter with which most rows are as wide as the header, then the widest."""
    scores = {}
    for candidate in (*DELIMITERS, BLANK):
        width = len(split_cells(header, candidate))
        fitting = sum(len(split_cells(row, candidate)) == width for row in rows)
        # blanks can surround any delimiter, so they are the last choice
        some = width > 1
        scores[candidate] = (some and (fitting > 0 or not rows), some, candidate != BLANK, fitting, width)
    return max(scores, key=scores.__getitem__)


def _parse_delimiter(delimiter: str) -> str:
    known = {"tab": "\t", "\\t": "\t", "blank": BLANK, "space": BLANK, "comma": ",", "semicolon": ";"}
    chosen = known.get(delimiter, delimiter)
    if len(chosen) != 1 or chosen.isalnum() or chosen in "\"'.+-_\r\n" or ord(chosen) > 126:
        raise invalid_request("delimiter", delimiter, "one character, such as , ; | a blank or a tab")
    return chosen


def _shorten(line: str) -> str:
    text = line.strip()
    return text if len(text) <= 60 else text[:60] + "…"


MAX_LINE_BYTES = 1024 * 1024
"""Max length of a line; also the size of the blocks that are parsed."""
_DELIMITER_NAMES = {";": "semicolons", "\t": "tabs", "|": "bars", BLANK: "blanks"}
"""Delimiters that the report mentions."""


@contextmanager
def open_csv(path: Path, options: ReadOptions, settings: Settings, naming: Naming | None = None) -> Iterator[Table]:
    """Open a CSV file as a table; raise InvalidDataError that names the row and column of an error.

    Columns of text are not read, and the table's facts say so. An empty cell is a missing value. Dates become seconds
    since the first one. naming: names the columns of a file without names, by default from `options.column_names`.
    """
    if naming is None and options.column_names is not None:
        naming = _name_from_option(options.column_names)
    header = read_header(path, options.delimiter, naming)
    if options.column_names is not None and not header.nameless:
        expected = "no `column_names` because the first line of the file holds names"
        raise invalid_request("column_names", ", ".join(options.column_names), expected)
    names = clean_names(header.names)
    with path.open("rb") as file:
        for _ in range(header.lines):
            file.readline()
        batches = _read_batches(path, _SingleBlanks(file) if header.delimiter == BLANK else file, header)
        first = next(batches, None)
        if first is None:
            yield Table(names, iter(()))
            return
        columns = _choose_readers(names, first, header)
        readers = {index: each for index, each in enumerate(columns) if each is not None}
        separator = _DELIMITER_NAMES.get(header.delimiter)
        facts = [f"columns are separated by {separator}"] if separator else []
        unread = [name for index, name in enumerate(names) if index not in readers]
        facts += describe_unread(unread, "they hold no numbers")
        stamps = [each.name for each in readers.values() if isinstance(each, StampColumn)]
        facts += [f"{name} holds dates, which were converted to seconds since the first one" for name in stamps]
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
        yield from stack_blocks([each.read(batch.column(index), row) for index, each in readers.items()])
        row += batch.num_rows
        batch = next(batches, None)
    if any(isinstance(each, NumberColumn) and each.commas for each in readers.values()):
        facts.append("numbers have decimal commas")


def _choose_readers(
    names: tuple[str, ...], batch: pa.RecordBatch, header: Header
) -> list[NumberColumn | StampColumn | None]:
    """Return the reader of each column, chosen by its first cells; None if most of them are text."""
    columns: list[NumberColumn | StampColumn | None] = []
    for name, column in zip(names, batch.columns, strict=True):
        number = NumberColumn(name, decimal_comma=header.delimiter != ",")
        columns.append(number if number.share(column) >= 0.5 else StampColumn.of(name, column))
    return columns


def _read_batches(path: Path, file: IO[bytes] | io.RawIOBase, header: Header) -> Iterator[pa.RecordBatch]:
    """Yield the rows as text cells; raise InvalidDataError if a row is not as wide as the header."""
    wrong: list[pacsv.InvalidRow] = []

    def note(row: pacsv.InvalidRow) -> str:
        wrong.append(row)
        return "error"

    keys = [str(index) for index in range(len(header.names))]
    try:
        reader = pacsv.open_csv(
            file,
            read_options=pacsv.ReadOptions(use_threads=False, block_size=MAX_LINE_BYTES, column_names=keys),
            parse_options=pacsv.ParseOptions(delimiter=header.delimiter, invalid_row_handler=note),
            convert_options=pacsv.ConvertOptions(
                column_types=dict.fromkeys(keys, pa.string()), strings_can_be_null=True, null_values=list(MISSING)
            ),
        )
        for batch in reader:
            if batch.num_rows:
                yield batch
    except (pa.ArrowException, OSError, ValueError) as error:
        text = first_line(error)
        if "Empty CSV" in text:
            return
        if wrong:
            row, count = f"row {wrong[0].number}", f"{wrong[0].actual_columns} values"
            expected = f"{len(keys)} values, one per column of the header"
            raise invalid_data(row, count, expected, f"{row} has {count}, expected {expected}") from None
        if "UTF8" in text or "UTF-8" in text:
            raise utf8_error(path) from None
        if "straddl" in text:
            value, expected = f"a line of more than {MAX_LINE_BYTES} bytes", f"lines of at most {MAX_LINE_BYTES} bytes"
            raise invalid_data("file", value, expected, f"The file has {value}, expected {expected}.") from None
        raise unreadable(
            "file", text, f"numbers separated by {_DELIMITER_NAMES.get(header.delimiter, 'commas')}"
        ) from None


class _SingleBlanks(io.RawIOBase):
    """A text file with each run of blanks as one blank, and no blanks at the ends of lines."""

    def __init__(self, file: IO[bytes]) -> None:
        self.file, self.rest = file, b""

    def readable(self) -> bool:
        """Return True."""
        return True

    def read(self, size: int = -1) -> bytes:
        """Return whole lines, about `size` bytes."""
        while True:
            chunk = self.file.read(max(size - len(self.rest), 1))
            text = self.rest + chunk
            end = text.rfind(b"\n") + 1 if chunk else len(text)
            text, self.rest = text[:end], text[end:]
            if len(self.rest) > MAX_LINE_BYTES:
                raise ValueError("a straddling line")
            out = re.sub(rb"[ \t]*\r?\n[ \t]*", b"\n", re.sub(rb"[ \t]+", b" ", text))
            if out.lstrip(b"\n") or not chunk:
                return out.lstrip(b" ")

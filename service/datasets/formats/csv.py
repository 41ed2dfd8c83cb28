"""Reading CSV and its kin: a line of column names, then numbers, separated by whatever separates them."""

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
from service.datasets.formats.table import Table, checked_names, first_line, left_out, stacked
from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError, invalid_data, invalid_request
from service.foundation.settings import Settings

SAMPLE_CHARACTERS = 256 * 1024
MAX_HEADER = 64 * 1024
DELIMITERS = (",", ";", "\t", "|")
BLANK = " "
"""Stands for any run of blanks and tabs."""
_NUMERIC = re.compile(rf"\s*(?:{NUMBER}|[+-]?(?:nan|inf(?:inity)?)|[+-]?\d+,\d+(?:[eE][+-]?\d+)?)\s*", re.IGNORECASE)
EXPECTED = "column names in the first line, separated by , ; | tabs or blanks"


@dataclass(frozen=True)
class Header:
    """names: of the columns, as they stand there; delimiter: one character, BLANK for runs; lines: up to the rows;
    nameless: whether they do not stand there."""

    names: tuple[str, ...]
    delimiter: str
    lines: int
    nameless: bool = False


Naming = Callable[[int], tuple[str, ...]]
"""Names of so many columns, of a file that has none; raises InvalidDataError where there are not as many."""


def read_header(path: Path, delimiter: str | None, naming: Naming | None = None) -> Header:
    """Find the header of a text file; raise InvalidDataError where there is none, and nobody names its columns."""
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
    if (longest := max(map(len, lines[: index + 1]))) > MAX_HEADER:
        raise invalid_data("header", f"{longest} characters", f"at most {MAX_HEADER}")
    if index != comment and _all_numbers(lines[index], delimiter):
        # as numpy.savetxt writes it: the names may stand in the comment above the numbers
        if naming is not None and not _names_stand(lines[comment] if comment is not None else "", lines[index]):
            return _nameless(lines, index, delimiter, naming)
        if comment is None:
            expected = f"{EXPECTED}, not numbers; or column_names=t,q1..q7,tau1..tau7 names them"
            raise invalid_data("header", _cut(lines[index]), expected)
        index = comment
    header = lines[index].strip().lstrip("#%") if index == comment else lines[index].strip("\r\n")
    if "\0" in header:
        raise invalid_data("file", "binary", "text in UTF-8")
    rows = _sample(lines, index)
    chosen = _delimiter(delimiter) if delimiter else _choose(header, rows)
    names = tuple(name.strip() for name in cells(header, chosen))
    if len(names) < 2:
        raise invalid_data("header", _cut(header), EXPECTED)
    widths = {len(cells(row, chosen)) for row in rows}
    if len(rows) > 1 and len(widths) == 1 and widths != {len(names)}:  # else it is a row that is wrong
        expected = f"{widths.pop()}, as each of the first {len(rows)} rows has so many values"
        raise invalid_data("header", f"{len(names)} names", expected)
    return Header(names, chosen, index + 1)


def _names_stand(comment: str, row: str) -> bool:
    """Whether a comment holds as many names as the row below it has numbers."""
    header = comment.strip().lstrip("#%")
    return any(1 < len(cells(header, each)) == len(cells(row.strip(), each)) for each in (*DELIMITERS, BLANK))


def _nameless(lines: list[str], index: int, delimiter: str | None, naming: Naming) -> Header:
    """The header of a file without one, whose first row of numbers is that line."""
    first = lines[index].strip("\r\n")
    rows = _sample(lines, index)
    chosen = _delimiter(delimiter) if delimiter else _choose(first, rows)
    return Header(naming(len(cells(first, chosen))), chosen, index, nameless=True)


def _sample(lines: list[str], index: int) -> list[str]:
    """The first rows below a line, without empty and overlong ones."""
    return [line for line in lines[index + 1 : index + 51] if line.strip() and len(line) <= MAX_HEADER]


def _given(names: tuple[str, ...]) -> Naming:
    """The names that a user gives."""

    def naming(width: int) -> tuple[str, ...]:
        if len(names) != width:
            raise invalid_data("column_names", f"{len(names)} names", f"{width}, as the rows have so many values")
        return names

    return naming


def cells(line: str, delimiter: str) -> list[str]:
    """What stands in a line, quotes removed; raise InvalidDataError where it cannot be told apart."""
    if delimiter == BLANK:
        return [cell.strip('"') for cell in line.split()]
    try:
        return next(csv.reader([line.strip("\r\n")], delimiter=delimiter), [])
    except csv.Error as error:
        raise invalid_data("header", str(error), EXPECTED) from None


def not_utf8(path: Path) -> InvalidDataError:
    """The error of a file that is no text in UTF-8, with its first wrong byte."""
    with path.open(encoding="utf-8") as file:
        try:
            while file.read(SAMPLE_CHARACTERS):
                pass
        except UnicodeDecodeError as error:
            return invalid_data("file", f"byte {error.object[error.start]:#04x}", "text in UTF-8")
    return invalid_data("file", "no text", "text in UTF-8")


def _first_lines(path: Path) -> list[str]:
    """The lines at the start of a file, the last one left out where it may be cut off."""
    with path.open(encoding="utf-8-sig", newline="") as file:
        try:
            text = file.read(SAMPLE_CHARACTERS)
        except UnicodeDecodeError as error:
            raise invalid_data("file", f"byte {error.object[error.start]:#04x}", "text in UTF-8") from None
    lines = text.split("\n")
    return lines[:-1] if len(text) == SAMPLE_CHARACTERS and len(lines) > 1 else lines


def _all_numbers(line: str, delimiter: str | None) -> bool:
    candidates = (_delimiter(delimiter),) if delimiter else (*DELIMITERS, BLANK)
    for candidate in candidates:
        filled = [cell for cell in cells(line, candidate) if cell.strip()]
        if filled and all(_NUMERIC.fullmatch(cell) for cell in filled):
            return True
    return False


def _choose(header: str, rows: list[str]) -> str:
    """The delimiter with which most rows are as wide as the header, then the widest."""
    scores = {}
    for candidate in (*DELIMITERS, BLANK):
        width = len(cells(header, candidate))
        fitting = sum(len(cells(row, candidate)) == width for row in rows)
        # blanks may stand beside any delimiter: they are the last resort
        some = width > 1
        scores[candidate] = (some and (fitting > 0 or not rows), some, candidate != BLANK, fitting, width)
    return max(scores, key=scores.__getitem__)


def _delimiter(delimiter: str) -> str:
    known = {"tab": "\t", "\\t": "\t", "blank": BLANK, "space": BLANK, "comma": ",", "semicolon": ";"}
    chosen = known.get(delimiter, delimiter)
    if len(chosen) != 1 or chosen.isalnum() or chosen in "\"'.+-_\r\n" or ord(chosen) > 126:
        raise invalid_request("delimiter", delimiter, "one of , ; | tab blank")
    return chosen


def _cut(line: str) -> str:
    text = line.strip()
    return text if len(text) <= 60 else text[:60] + "…"


LINE_BYTES = 1024 * 1024
"""Longest line, and how much of a file is parsed at a time."""
_NAMES = {";": "semicolons", "\t": "tabs", "|": "bars", BLANK: "blanks"}
"""Delimiters that are worth telling."""


@contextmanager
def open_csv(path: Path, options: ReadOptions, settings: Settings, naming: Naming | None = None) -> Iterator[Table]:
    """Open a CSV file as a table; raise InvalidDataError naming row and column of what is wrong.

    naming: names the columns of a file without names, by default `options.column_names`.

    Columns of text are left out, which is a fact of the table; an empty cell is a missing value; times as dates become
    seconds since the first.
    """
    if naming is None and options.column_names is not None:
        naming = _given(options.column_names)
    header = read_header(path, options.delimiter, naming)
    if options.column_names is not None and not header.nameless:
        raise invalid_request(
            "column_names", ", ".join(options.column_names), "none, as the first line of the file holds names"
        )
    names = checked_names(header.names)
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
    columns: list[NumberColumn | StampColumn | None] = []
    for name, column in zip(names, batch.columns, strict=True):
        number = NumberColumn(name, decimal_comma=header.delimiter != ",")
        columns.append(number if number.share(column) >= 0.5 else StampColumn.of(name, column))
    return columns


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
        text = first_line(error)
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

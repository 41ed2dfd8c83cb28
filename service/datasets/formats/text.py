"""Layout of a text table: encoding, separator and header, and its rows as lines of UTF-8.

CleverCSV finds the separator.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import clevercsv

from service.datasets.formats.encoding import decode_head
from service.datasets.formats.header import (
    EXPECTED,
    MAX_HEADER_CHARS,
    Header,
    Naming,
    Record,
    find_header,
    find_transposed,
)
from service.foundation.errors import InvalidDataError, invalid_data, invalid_request

SAMPLE_BYTES = 512 * 1024
"""Bytes at the start of a file that show its layout."""
DIALECT_CHARS = 16 * 1024
"""Max characters that CleverCSV reads."""
MAX_WORD_CHARS = 200
"""Max characters of a word that CleverCSV reads: its time grows with their square."""
MAX_LINE_BYTES = 1024 * 1024
"""Max length of a line; also the size of the blocks that are parsed."""
DELIMITERS = (",", ";", "\t", "|", " ")
_LONG_WORD = re.compile(rf"([^,;\t| \"'\r\n]{{{MAX_WORD_CHARS}}})[^,;\t| \"'\r\n]+")
BLANK = " "
"""The delimiter that stands for any run of blanks and tabs."""


@dataclass(frozen=True)
class TextLayout:
    """Layout of a text table."""

    encoding: str
    delimiter: str
    """One character; BLANK for runs of blanks."""
    quote: str
    multiline: bool
    """Whether quoted cells hold line ends."""
    header: Header
    """Without names if the table is transposed."""
    transposed: bool
    """Whether each row is a name and its numbers."""
    facts: tuple[str, ...]
    """Sentences for the report."""


def read_layout(path: Path, delimiter: str | None, naming: Naming | None = None) -> TextLayout:
    """Find the layout of a text table. naming: names the columns of a file without names.

    Raise InvalidDataError if there is no table, or if it has no names and `naming` is not given.
    """
    encoding, lines = _read_sample(path)
    if not any(map(str.strip, lines)):
        raise invalid_data("header", "empty", "column names in the first line")
    if any(re.search(r":\s*ARRAY\s*\[", line) for line in lines):
        message = "The file is text of a PLC program, not a table. Write one row of numbers per time."
        raise invalid_data("file", "PLC structured text", "a table with one row per time", message)
    chosen, quote = (_parse_delimiter(delimiter), '"') if delimiter else _find_dialect(lines)
    records = _split_records(lines, chosen, quote)
    multiline = sum(each.end - each.begin > 1 for each in records) > 1
    transposed = find_transposed(records)
    header = find_header(records, naming) if transposed is None else transposed
    facts = () if encoding.startswith("utf-8") else (f"the text is read as {encoding}",)
    return TextLayout(encoding, chosen, quote, multiline, header, transposed is not None, facts)


def _read_sample(path: Path) -> tuple[str, list[str]]:
    """Return the encoding, and the lines at the start of a file, without the last one if it may be incomplete."""
    with path.open("rb") as file:
        head = file.read(SAMPLE_BYTES)
    if (found := decode_head(head, whole := len(head) < SAMPLE_BYTES)) is None:
        raise invalid_data("file", "binary", "text, in UTF-8 if possible")
    encoding, text = found
    lines = io.StringIO(text, newline="").readlines()
    return encoding, lines[:-1] if not whole and len(lines) > 1 else lines


def _find_dialect(lines: Sequence[str]) -> tuple[str, str]:
    """Return the delimiter and the quote."""
    chars, some = 0, list[str]()
    for line in lines:
        if some and chars + len(line) > DIALECT_CHARS:
            break
        chars += len(line)
        some.append(line)
    sample = "".join(some)[:DIALECT_CHARS]  # the first line may be longer
    text = _LONG_WORD.sub(r"\1", sample.replace("\0", ""))
    found = clevercsv.Detector().detect(text, delimiters=DELIMITERS)
    if found is None:
        return ",", '"'
    delimiter, quote = found.delimiter or ",", found.quotechar or '"'
    if delimiter == BLANK and '"' in sample:  # lists in quoted cells have blanks, too
        for other in DELIMITERS[:-1]:
            widths = {len(each.cells) for each in _split_records(lines, other, '"')}
            if len(widths) == 1 and widths != {1}:
                return other, '"'
    return delimiter, quote


def _split_records(lines: Sequence[str], delimiter: str, quote: str) -> list[Record]:
    """Return the rows and comments in some lines, without empty ones."""
    out: list[Record] = []
    split: list[tuple[list[str], int]] = []
    try:
        split.extend(split_rows(lines, delimiter, quote))
    except csv.Error as error:
        if not split:
            raise invalid_data("header", str(error), f"{EXPECTED}, at most {MAX_HEADER_CHARS} characters") from None
    begin = 0
    for cells, end in split:  # damage below is reported by the reader of the rows
        if any(map(str.strip, cells)):
            comment = cells[0].lstrip()[:1] in ("#", "%")
            if comment and cells[0].strip() != "%time":  # of `rostopic echo -p`
                cells[0] = cells[0].lstrip("#% ")
            if kept := cells if cells[0] or not comment else cells[1:]:
                out.append(Record(kept, begin, end, comment))
        begin = end
    if not out:
        raise invalid_data("header", "empty", EXPECTED)
    return out


def split_rows(lines: Iterable[str], delimiter: str, quote: str) -> Iterator[tuple[list[str], int]]:
    """Yield the cells of each row, and the number of lines until its end; raise csv.Error."""
    if delimiter == BLANK:
        yield from (([cell.strip(quote) for cell in line.split()], end) for end, line in enumerate(lines, start=1))
        return
    reader = csv.reader(lines, delimiter=delimiter, quotechar=quote)
    for cells in reader:
        yield cells, reader.line_num


def _parse_delimiter(delimiter: str) -> str:
    known = {"tab": "\t", "\\t": "\t", "blank": BLANK, "space": BLANK, "comma": ",", "semicolon": ";"}
    chosen = known.get(delimiter, delimiter)
    if len(chosen) != 1 or chosen.isalnum() or chosen in "\"'.+-_\r\n" or ord(chosen) > 126:
        raise invalid_request("delimiter", delimiter, "one character, such as , ; | a blank or a tab")
    return chosen


def byte_error(error: UnicodeDecodeError) -> InvalidDataError:
    """Return the error for a byte that does not belong to a text."""
    byte = f"byte {error.object[error.start]:#04x}"
    return invalid_data(
        "file", byte, f"text in {error.encoding}", f"The file is not text in {error.encoding}: it contains {byte}."
    )


class TextLines(io.RawIOBase):
    """The lines of a text after some that are skipped, as UTF-8.

    With `blanks`, each run of blanks and tabs becomes one blank, and lines have none at the ends.
    """

    def __init__(self, path: Path, encoding: str, skipped: int, blanks: bool) -> None:
        self.file = path.open(encoding=encoding, newline="")
        self.blanks, self.rest = blanks, ""
        for _ in range(skipped):
            self.file.readline()

    def close(self) -> None:
        """Close the file."""
        self.file.close()
        super().close()

    def readable(self) -> bool:
        """Return True."""
        return True

    def read(self, size: int = -1) -> bytes:
        """Return about `size` bytes; raise UnicodeDecodeError, or ValueError if a line is too long."""
        while True:
            chunk = self.file.read(max(size - len(self.rest), 1))
            if not self.blanks:
                return chunk.encode()
            text = self.rest + chunk
            end = text.rfind("\n") + 1 if chunk else len(text)
            text, self.rest = text[:end], text[end:]
            if len(self.rest) > MAX_LINE_BYTES:
                raise ValueError("a straddling line")
            out = re.sub(r"[ \t]*\r?\n[ \t]*", "\n", re.sub(r"[ \t]+", " ", text))
            if out.lstrip("\n") or not chunk:
                return out.lstrip(" ").encode()

"""The first lines of a text file: which of them names the columns, and what separates these."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path

from service.foundation.errors import InvalidDataError, invalid_data, invalid_request

SAMPLE_CHARACTERS = 256 * 1024
MAX_HEADER = 64 * 1024
SAMPLE_ROWS = 50
DELIMITERS = (",", ";", "\t", "|")
BLANK = " "
"""Stands for any run of blanks and tabs."""
NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_NUMERIC = re.compile(rf"\s*(?:{NUMBER}|[+-]?(?:nan|inf(?:inity)?)|[+-]?\d+,\d+(?:[eE][+-]?\d+)?)\s*", re.IGNORECASE)
_WORDS = {"tab": "\t", "\\t": "\t", "blank": BLANK, "space": BLANK, "comma": ",", "semicolon": ";"}
EXPECTED = "column names in the first line, separated by , ; | tabs or blanks"


@dataclass(frozen=True)
class Header:
    """names: of the columns, as they stand there; delimiter: one character, BLANK for runs; lines: up to the rows."""

    names: tuple[str, ...]
    delimiter: str
    lines: int


def read_header(path: Path, delimiter: str | None) -> Header:
    """Find the header of a text file; raise InvalidDataError where there is none."""
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
        # as numpy.savetxt writes it: the names stand in the comment above the numbers
        if comment is None:
            raise invalid_data("header", _cut(lines[index]), f"{EXPECTED}, not numbers")
        index = comment
    header = lines[index].strip().lstrip("#%") if index == comment else lines[index].strip("\r\n")
    if "\0" in header:
        raise invalid_data("file", "binary", "text in UTF-8")
    rows = [line for line in lines[index + 1 : index + 1 + SAMPLE_ROWS] if line.strip() and len(line) <= MAX_HEADER]
    chosen = _said(delimiter) if delimiter else _choose(header, rows)
    names = tuple(name.strip() for name in cells(header, chosen))
    if len(names) < 2:
        raise invalid_data("header", _cut(header), EXPECTED)
    return Header(names, chosen, index + 1)


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
    candidates = (_said(delimiter),) if delimiter else (*DELIMITERS, BLANK)
    for candidate in candidates:
        found = [cell for cell in cells(line, candidate) if cell.strip()]
        if found and all(_NUMERIC.fullmatch(cell) for cell in found):
            return True
    return False


def _choose(header: str, rows: list[str]) -> str:
    """The delimiter with which most rows are as wide as the header, then the widest."""
    scores = {}
    for candidate in (*DELIMITERS, BLANK):
        width = len(cells(header, candidate))
        fitting = sum(len(cells(row, candidate)) == width for row in rows)
        # blanks may stand beside any delimiter: they are the last resort
        scores[candidate] = (width > 1 and (fitting > 0 or not rows), candidate != BLANK, fitting, width)
    return max(scores, key=scores.__getitem__)


def _said(delimiter: str) -> str:
    chosen = _WORDS.get(delimiter, delimiter)
    if len(chosen) != 1 or chosen.isalnum() or chosen in "\"'.+-_\r\n" or ord(chosen) > 126:
        raise invalid_request("delimiter", delimiter, "one of , ; | tab blank")
    return chosen


def _cut(line: str) -> str:
    text = line.strip()
    return text if len(text) <= 60 else text[:60] + "…"

"""Header of a text table: names of the columns and their units, among lines above the table.

Rows are those as wide as most. A row of names has text where the rows below have numbers.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from service.datasets.formats.cells import NUMBER
from service.datasets.mapping.recognition import find_times, interpret_name
from service.datasets.mapping.vocabulary import is_unit
from service.foundation.errors import invalid_data
from service.foundation.text import counted

SAMPLE_ROWS = 50
"""Rows that show which columns hold numbers."""
MAX_HEADER_CHARS = 64 * 1024
MAX_UNIT_CHARS = 12
EXPECTED = "column names above the rows, separated by , ; | tabs or blanks"
_NUMERIC = re.compile(rf"\s*(?:{NUMBER}|[+-]?(?:nan|inf(?:inity)?)|[+-]?\d+,\d+(?:[eE][+-]?\d+)?)\s*", re.IGNORECASE)
Naming = Callable[[int], tuple[str, ...]]
"""Function that returns names for a number of columns; it raises InvalidDataError if it has not as many."""


@dataclass(frozen=True)
class Header:
    """Names of the columns, and their place in a text."""

    names: tuple[str, ...]
    lines: int
    """Lines before the first row."""
    units: tuple[str, ...] = ()
    """Units in a row below the names, "" for columns without one; empty if there is no such row."""
    nameless: bool = False
    """Whether the names are not in the file."""
    facts: tuple[str, ...] = ()
    """Sentences for the report."""


@dataclass(frozen=True)
class Record:
    """Cells of a row or of a comment."""

    cells: list[str]
    begin: int
    """Lines of the file before it."""
    end: int
    """Lines of the file until its end."""
    comment: bool


def find_header(records: Sequence[Record], naming: Naming | None = None) -> Header:
    """Return the header of a table: the names above its first row, or in a comment.

    Rows are those as wide as most. A row of names has text where the rows below have numbers.
    """
    rows = [each for each in records if not each.comment]
    if not rows:
        return Header(_named(records[-1].cells), records[-1].end)
    wide = _widest(rows)
    first, table = rows.index(wide[0]), [each.cells for each in wide[:SAMPLE_ROWS]]
    columns = _number_columns(table)
    titles = 0
    while titles < len(table) and _is_title(table[titles], columns):
        titles += 1
    if titles == 0:
        return _header_above(records, rows, first, table, naming)
    named = max(range(titles), key=lambda each: (_meaningful(table[each]), -each))
    units: tuple[str, ...] = ()
    facts = _skipped(named + first)
    if named + 1 < titles and _is_units(table[named + 1]):
        units = tuple(cell.strip(" []()") if is_unit(cell.strip(" []()")) else "" for cell in table[named + 1])
        facts.append("units are read from the row below the column names")
    end = rows[first + named + bool(units)].end
    return Header(_named(table[named]), end, units, facts=tuple(facts))


def find_transposed(records: Sequence[Record]) -> Header | None:
    """Return the header of a transposed table, without names, if each row is a name and its numbers."""
    rows = _widest([each for each in records if not each.comment])
    if (
        len(rows) < 2
        or len(rows[0].cells) < 3
        or any(_is_number(row.cells[0]) for row in rows)
        or not all(_is_number(cell) for row in rows for cell in row.cells[1:] if cell.strip())
        or _meaningful([row.cells[0] for row in rows]) < 2
    ):
        return None
    return Header(
        (),
        rows[0].begin,
        facts=tuple(_skipped(sum(not each.comment and each.end <= rows[0].begin for each in records))),
    )


def _widest(rows: Sequence[Record]) -> list[Record]:
    """Return the rows as wide as most."""
    widths = Counter(len(each.cells) for each in rows[-SAMPLE_ROWS:])
    width = max(widths, key=lambda each: (widths[each], each), default=0)
    return [each for each in rows if len(each.cells) == width]


def _header_above(
    records: Sequence[Record], rows: Sequence[Record], first: int, table: Sequence[list[str]], naming: Naming | None
) -> Header:
    """Return the header of a table whose first row holds numbers: names in a comment, or given by a function."""
    row, width = rows[first], len(table[0])
    above = [each.cells for each in records if each.comment and each.end <= row.begin and len(each.cells) == width]
    if above:
        return Header(_named(above[-1]), row.begin)
    before = rows[first - 1].cells if first else []
    if len(before) > 1 and 2 * sum(map(_is_number, before)) < len(before):
        if len(before) == width - 1 and not any(cells[-1].strip() for cells in table):  # a delimiter ends each row
            return Header((*_named(before), ""), row.begin, facts=tuple(_skipped(first - 1)))
        if len(before) == width - 1 and [cells[0] for cells in table] == [str(k + 1) for k in range(len(table))]:
            return Header(("row", *_named(before)), row.begin, facts=tuple(_skipped(first - 1)))  # as R writes it
        expected = f"{width} names because each of the first {len(table)} rows has {width} values"
        raise invalid_data("header", f"{len(before)} names", expected)
    naming = naming or _topic_echo_naming(table[0])
    if naming is None:
        raise invalid_data(
            "header", _shorten(" ".join(row.cells)), f"{EXPECTED}. Or set column_names=t,q1..q7,tau1..tau7"
        )
    return Header(naming(width), row.begin, nameless=True, facts=tuple(_skipped(first)))


def _topic_echo_naming(cells: Sequence[str]) -> Naming | None:
    """Return the names of the columns that `ros2 topic echo --csv` writes of `sensor_msgs/JointState`, if it is that.

    They are the stamp's seconds and nanoseconds, its frame, and the elements of name, position, velocity and effort.
    """
    n = 0
    while 3 + n < len(cells) and not _is_number(cells[3 + n]):
        n += 1
    if n == 0 or len(cells) != 3 + 4 * n or not all(map(_is_number, [*cells[:2], *cells[3 + n :]])):
        return None
    arrays = [f"{name}[{j}]" for name in ("name", "position", "velocity", "effort") for j in range(n)]
    return lambda width: ("header.stamp.sec", "header.stamp.nanosec", "header.frame_id", *arrays)


def _named(cells: Sequence[str]) -> tuple[str, ...]:
    names = tuple(cell.strip() for cell in cells)
    if (long := sum(map(len, names))) > MAX_HEADER_CHARS:
        raise invalid_data("header", f"{long} characters long", f"at most {MAX_HEADER_CHARS}")
    if len(names) < 2:
        raise invalid_data("header", _shorten(" ".join(cells)), EXPECTED)
    return names


def _skipped(rows: int) -> list[str]:
    return [f"{counted(rows, 'row')} above the column names {'is' if rows == 1 else 'are'} not read"] if rows else []


def _number_columns(table: Sequence[Sequence[str]]) -> list[int]:
    """Return the columns with numbers in at least half of the rows below the first."""
    below = table[1:]
    return [j for j in range(len(table[0])) if below and 2 * sum(_is_number(row[j]) for row in below) >= len(below)]


def _is_title(cells: Sequence[str], number_columns: Sequence[int]) -> bool:
    """Return whether a row has text in most of the columns of numbers."""
    of = number_columns or range(len(cells))
    return 2 * sum(bool(cells[j].strip()) and not _is_number(cells[j]) for j in of) > len(of)


def _meaningful(cells: Sequence[str]) -> int:
    """Return how many cells are names of quantities or times."""
    return sum(bool(interpret_name(cell)) for cell in cells) + len(find_times(list(cells)))


def _is_units(cells: Sequence[str]) -> bool:
    """Return whether a row has units, in at least half of its cells with text."""
    filled = [cell.strip(" []()") for cell in cells if cell.strip(" []()-–")]
    return all(len(cell) <= MAX_UNIT_CHARS for cell in filled) and 2 * sum(map(is_unit, filled)) >= len(filled) > 0


def _is_number(cell: str) -> bool:
    return _NUMERIC.fullmatch(cell) is not None


def _shorten(line: str) -> str:
    text = line.strip()
    return text if len(text) <= 60 else text[:60] + "…"

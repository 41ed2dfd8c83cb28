"""Converting columns of text cells to columns of numbers: numbers, dates with times, and lists in brackets."""

from __future__ import annotations

import re
from datetime import UTC, datetime

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from dateutil import parser

from lipcore.data.samples import Array
from service.datasets.formats.arrow import Node, plan, since
from service.foundation.errors import InvalidDataError, invalid_data

NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
MISSING = ("", "NA", "N/A", "<NA>", "na", "null", "NULL", "None")
"""Cells that mean a missing value. `nan` in any case is a number."""
_PATTERN = rf"(?i)^(?:{NUMBER}|[+-]?(?:nan|inf(?:inity)?))$"
_COMMA = r"^([+-]?\d*),(\d+(?:[eE][+-]?\d+)?)$"
_CLOCK = (
    r"^(?P<day>.*?)\b(?P<minute>\d{1,2}:\d{2}):(?P<second>\d{1,2}(?:[.,]\d+)?)(?P<rest>[^\d]*|\s*\S*[+-]\d{2}:?\d{2})$"
)
"""A time of day, with a date or without; rest: am or pm, or the time zone."""


def plan_cells(name: str, cells: pa.Array, decimal_comma: bool, widest: int) -> Node | None:
    """Return the reader of a column of text, None if it holds no numbers. cells: its first rows."""
    number = NumberCells(name, decimal_comma)
    if number.share(cells) >= 0.5:
        return number
    return StampCells.of(name, cells) or ClockCells.of(name, cells) or ListCells.of(name, cells, widest)


class NumberCells:
    """Numbers; a missing cell becomes NaN.

    decimal_comma: whether cells such as `1,5` are allowed; `commas` is True after one was found.
    """

    def __init__(self, name: str, decimal_comma: bool) -> None:
        self.name, self.decimal_comma = name, decimal_comma
        self.names, self.units = [name], dict[str, str]()
        self.commas = False

    def read(self, array: pa.Array, first_row: int) -> list[Array]:
        """Read cells; raise InvalidDataError with the row, from 1, of the first that is not a number."""
        if not self.commas:
            try:
                return [_floats(pc.cast(array, pa.float64()))]
            except pa.ArrowInvalid:
                pass  # rare: blanks, a plus, a decimal comma, a word for "missing", or not a number
        text = self._tidy(array)
        wrong = pc.invert(pc.fill_null(pc.match_substring_regex(text, _PATTERN), True))
        if (first := pc.index(wrong, True).as_py()) >= 0:
            raise invalid_data(f"{self.name}, row {first_row + first}", array[first].as_py() or "empty", "a number")
        try:
            return [_floats(pc.cast(text, pa.float64()))]
        except pa.ArrowInvalid:  # too large for a double
            return [np.array([np.nan if cell is None else float(cell) for cell in text.to_pylist()])]

    def share(self, cells: pa.Array) -> float:
        """Return the share of non-empty cells that are numbers, 1 if all are empty."""
        text = self._tidy(cells)
        filled = len(text) - text.null_count
        return 1.0 if filled == 0 else (pc.sum(pc.match_substring_regex(text, _PATTERN)).as_py() or 0) / filled

    def _tidy(self, cells: pa.Array) -> pa.Array:
        text = pc.utf8_trim_whitespace(cells)
        text = pc.if_else(pc.is_in(text, value_set=pa.array(MISSING)), pa.scalar(None, pa.string()), text)
        text = pc.replace_substring_regex(text, r"^\+", "")
        if self.decimal_comma and not self.commas:
            marks = pc.match_substring_regex(text, _COMMA), pc.match_substring(text, ".")
            commas, points = (pc.sum(each).as_py() or 0 for each in marks)
            self.commas = 0 < commas >= points
        if self.commas:  # then a point is not decimal; it can only separate thousands
            text = pc.replace_substring_regex(pc.replace_substring(text, ".", "·"), _COMMA, r"\1.\2")
        return text


class StampCells:
    """Dates with times in the form of ISO 8601, read as seconds since the first one, with nanoseconds."""

    def __init__(self, name: str, kind: pa.DataType) -> None:
        self.name, self.kind = name, kind
        self.names, self.units = [name], {name: "s"}
        self.origin: int | None = None

    @staticmethod
    def of(name: str, cells: pa.Array) -> StampCells | None:
        """Return the reader if every non-empty cell is such a time, else None."""
        if cells.null_count == len(cells):
            return None
        for kind in (pa.timestamp("ns"), pa.timestamp("ns", "UTC")):
            try:
                pc.cast(pc.utf8_trim_whitespace(cells), kind)
            except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
                continue
            return StampCells(name, kind)
        return None

    def read(self, array: pa.Array, first_row: int) -> list[Array]:
        """Read cells as s; raise InvalidDataError with the row of the first that is not a time."""
        text = pc.utf8_trim_whitespace(array)
        try:
            stamps = pc.cast(text, self.kind)
        except pa.ArrowInvalid:
            for row, cell in enumerate(text):
                try:
                    pc.cast(cell, self.kind)
                except pa.ArrowInvalid:
                    raise invalid_data(f"{self.name}, row {first_row + row}", cell.as_py(), "a time") from None
            raise
        seconds, self.origin = since(stamps, self.origin, 1e-9)
        return [seconds]


class ClockCells:
    """Times of day, with a date in any form that dateutil reads or without, as seconds since the first one.

    In `05/01/2024` the month is first, in `01.05.2024` the day.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.names, self.units = [name], {name: "s"}
        self.origin: tuple[float, float] | None = None
        """Minute and second of the first one, s."""
        self._minutes: dict[tuple[str, str, str], float] = {}

    @staticmethod
    def of(name: str, cells: pa.Array) -> ClockCells | None:
        """Return the reader if every non-empty cell is such a time, else None."""
        filled = pc.drop_null(cells)
        try:
            found = len(filled) > 0 and ClockCells(name).read(filled, 1)
        except InvalidDataError:
            return None
        return ClockCells(name) if found else None

    def read(self, array: pa.Array, first_row: int) -> list[Array]:
        """Read cells as s; raise InvalidDataError with the row of the first that is not a time."""
        text = pc.utf8_trim_whitespace(array)
        parts = pc.extract_regex(text, _CLOCK)
        wrong = pc.and_(pc.is_null(parts), pc.is_valid(text))
        if (first := pc.index(wrong, True).as_py()) >= 0:
            raise invalid_data(f"{self.name}, row {first_row + first}", text[first].as_py(), "a time")
        out = np.full(len(array), np.nan)
        for row, part in enumerate(parts.to_pylist()):
            if part is not None:
                minute = self._minute(part["day"], part["minute"], part["rest"])
                second = float(part["second"].replace(",", "."))
                self.origin = self.origin or (minute, second)
                out[row] = (minute - self.origin[0]) + (second - self.origin[1])
        return [out]

    def _minute(self, day: str, minute: str, rest: str) -> float:
        """Return the time of a minute in s."""
        if (known := self._minutes.get((day, minute, rest))) is None:
            text = f"{day} {minute}:00 {rest}".strip()
            try:
                found = parser.parse(text, dayfirst="." in day, default=datetime(2000, 1, 1, tzinfo=UTC))
            except (ValueError, OverflowError):
                raise invalid_data(self.name, text, "times, such as 2024-05-01 12:00:00.25") from None
            known = self._minutes[day, minute, rest] = found.timestamp()
        return known


class ListCells:
    """Lists of numbers in brackets, such as `[0.5, 1.2]` and `[0.5 1.2]`, in columns `name[0]`, `name[1]` and so on."""

    def __init__(self, name: str, node: Node) -> None:
        self.name, self.node = name, node
        self.names, self.units = node.names, node.units

    @staticmethod
    def of(name: str, cells: pa.Array, widest: int) -> ListCells | None:
        """Return the reader if every non-empty cell is a list of numbers, else None."""
        try:
            lists = _split_lists(name, pc.drop_null(cells), 1)
        except InvalidDataError:
            return None
        node = plan(name, lists.type, lists, widest) if len(lists) else None
        return None if node is None else ListCells(name, node)

    def read(self, array: pa.Array, first_row: int) -> list[Array]:
        """Read cells; raise InvalidDataError with the row of the first that is not such a list."""
        return self.node.read(_split_lists(self.name, array, first_row), first_row)


def _split_lists(name: str, array: pa.Array, first_row: int) -> pa.Array:
    text = pc.utf8_trim(array, " \t\r\n")
    wrong = pc.invert(pc.fill_null(pc.match_substring_regex(text, r"(?s)^[\[({].*[\])}]$"), True))
    if (first := pc.index(wrong, True).as_py()) >= 0:
        raise invalid_data(f"{name}, row {first_row + first}", text[first].as_py(), "a list in brackets")
    inner = pc.utf8_trim(text, "[](){} \t\r\n,;")
    inner = pc.if_else(pc.equal(inner, ""), pa.scalar(None, pa.string()), inner)
    lists = pc.split_pattern_regex(inner, r"\s*[,;]\s*|\s+")
    try:
        values = pc.cast(lists.flatten(), pa.float64())
    except pa.ArrowInvalid:
        number = rf"{NUMBER}|[+-]?(?:nan|inf)"
        good = rf"(?is)^(?:{number})(?:(?:\s*[,;]\s*|\s+)(?:{number}))*$"
        first = pc.index(pc.invert(pc.fill_null(pc.match_substring_regex(inner, good), True)), True).as_py()
        row, cell = max(first, 0), text[max(first, 0)].as_py()
        raise invalid_data(f"{name}, row {first_row + row}", cell, "a list of numbers") from None
    return pa.ListArray.from_arrays(lists.offsets, values, mask=lists.is_null() if lists.null_count else None)


def quoted_names(cell: str) -> tuple[str, ...]:
    """Return the names in a list of texts, such as `['elbow', 'wrist']`."""
    return tuple(re.findall(r"['\"]([^'\"]+)['\"]", cell))


def _floats(column: pa.Array) -> Array:
    values: Array = column.to_numpy(zero_copy_only=False)
    return values

"""Columns of text cells as numbers: which of them hold numbers, and what each cell says."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lipcore.data.samples import Array
from service.datasets.formats.csv_header import NUMBER
from service.foundation.errors import invalid_data

MISSING = ("", "NA", "N/A", "<NA>", "na", "null", "NULL", "None")
"""Cells that say there is no value; `nan` in any case is a number of its own."""
_PATTERN = rf"(?i)^(?:{NUMBER}|[+-]?(?:nan|inf(?:inity)?))$"
_COMMA = r"^([+-]?\d*),(\d+(?:[eE][+-]?\d+)?)$"
_INT_MIN = np.iinfo(np.int64).min


class NumberColumn:
    """A column of numbers, NaN where a cell is missing.

    decimal_comma: whether cells may be written `1,5`; it was used where `commas` is True afterwards.
    """

    def __init__(self, name: str, decimal_comma: bool) -> None:
        self.name, self.decimal_comma = name, decimal_comma
        self.commas = False

    def read(self, column: pa.Array, first_row: int) -> Array:
        """Some cells (rows,); raise InvalidDataError with the row, counted from 1, of the first that is no number."""
        if not self.commas:
            try:
                return _floats(pc.cast(column, pa.float64()))
            except pa.ArrowInvalid:
                pass  # the exception: blanks, a plus, a decimal comma, a word for "missing", or no number at all
        text = self._tidy(column)
        wrong = pc.invert(pc.fill_null(pc.match_substring_regex(text, _PATTERN), True))
        if (first := pc.index(wrong, True).as_py()) >= 0:
            raise invalid_data(f"{self.name}, row {first_row + first}", column[first].as_py() or "empty", "a number")
        try:
            return _floats(pc.cast(text, pa.float64()))
        except pa.ArrowInvalid:  # beyond what a double holds
            return np.array([np.nan if cell is None else float(cell) for cell in text.to_pylist()])

    def share(self, column: pa.Array) -> float:
        """Share of the cells with anything in them that are numbers, 1 where all are empty."""
        text = self._tidy(column)
        filled = len(text) - text.null_count
        return 1.0 if filled == 0 else (pc.sum(pc.match_substring_regex(text, _PATTERN)).as_py() or 0) / filled

    def _tidy(self, column: pa.Array) -> pa.Array:
        text = pc.utf8_trim_whitespace(column)
        text = pc.if_else(pc.is_in(text, value_set=pa.array(MISSING)), pa.scalar(None, pa.string()), text)
        text = pc.replace_substring_regex(text, r"^\+", "")
        if self.decimal_comma and not self.commas:
            marks = pc.match_substring_regex(text, _COMMA), pc.match_substring(text, ".")
            commas, points = (pc.sum(each).as_py() or 0 for each in marks)
            self.commas = 0 < commas >= points
        if self.commas:  # then a point is none: it parts thousands, if anything
            text = pc.replace_substring_regex(pc.replace_substring(text, ".", "·"), _COMMA, r"\1.\2")
        return text


class StampColumn:
    """A column of dates with times (ISO 8601): seconds since the first of them."""

    def __init__(self, name: str, kind: pa.DataType) -> None:
        self.name, self.kind = name, kind
        self.origin: int | None = None

    @staticmethod
    def of(name: str, column: pa.Array) -> StampColumn | None:
        """Such a column where every cell with anything in it is a date with a time."""
        if column.null_count == len(column):
            return None
        for kind in (pa.timestamp("ns"), pa.timestamp("ns", "UTC")):
            try:
                pc.cast(pc.utf8_trim_whitespace(column), kind)
            except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
                continue
            return StampColumn(name, kind)
        return None

    def read(self, column: pa.Array, first_row: int) -> Array:
        """Some cells (rows,) in s; raise InvalidDataError with the row of the first that is no time."""
        text = pc.utf8_trim_whitespace(column)
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
        return seconds


def since(stamps: pa.Array, origin: int | None, unit: float) -> tuple[Array, int | None]:
    """Times as integers of a unit in s → seconds since the first one, which is kept exact; and that first one."""
    whole = pc.fill_null(pc.cast(stamps, pa.int64()), _INT_MIN).to_numpy(zero_copy_only=False)
    given = whole != _INT_MIN
    if origin is None and given.any():
        origin = int(whole[given.argmax()])
    seconds = np.full(len(whole), np.nan)
    seconds[given] = (whole[given] - (origin or 0)) * unit
    return seconds, origin


def _floats(column: pa.Array) -> Array:
    found: Array = column.to_numpy(zero_copy_only=False)
    return found

"""Converting Arrow columns to columns of numbers: text cells, lists (`name[0]`) and structures (`name.part`)."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lipcore.data.samples import Array
from service.datasets.formats.table import SAME_LENGTH
from service.foundation.errors import invalid_data

NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
MISSING = ("", "NA", "N/A", "<NA>", "na", "null", "NULL", "None")
"""Cells that mean a missing value. `nan` in any case is a number."""
_PATTERN = rf"(?i)^(?:{NUMBER}|[+-]?(?:nan|inf(?:inity)?))$"
_COMMA = r"^([+-]?\d*),(\d+(?:[eE][+-]?\d+)?)$"
_INT_MIN = np.iinfo(np.int64).min


class NumberColumn:
    """A text column of numbers; a missing cell becomes NaN.

    decimal_comma: whether cells such as `1,5` are allowed; `commas` is True after one was found.
    """

    def __init__(self, name: str, decimal_comma: bool) -> None:
        self.name, self.decimal_comma = name, decimal_comma
        self.commas = False

    def read(self, column: pa.Array, first_row: int) -> Array:
        """Read cells (rows,); raise InvalidDataError with the row, from 1, of the first that is not a number."""
        if not self.commas:
            try:
                return _floats(pc.cast(column, pa.float64()))
            except pa.ArrowInvalid:
                pass  # rare: blanks, a plus, a decimal comma, a word for "missing", or not a number
        text = self._tidy(column)
        wrong = pc.invert(pc.fill_null(pc.match_substring_regex(text, _PATTERN), True))
        if (first := pc.index(wrong, True).as_py()) >= 0:
            raise invalid_data(f"{self.name}, row {first_row + first}", column[first].as_py() or "empty", "a number")
        try:
            return _floats(pc.cast(text, pa.float64()))
        except pa.ArrowInvalid:  # too large for a double
            return np.array([np.nan if cell is None else float(cell) for cell in text.to_pylist()])

    def share(self, column: pa.Array) -> float:
        """Return the share of non-empty cells that are numbers, 1 if all are empty."""
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
        if self.commas:  # then a point is not decimal; it can only separate thousands
            text = pc.replace_substring_regex(pc.replace_substring(text, ".", "·"), _COMMA, r"\1.\2")
        return text


class StampColumn:
    """A text column of dates with times (ISO 8601), read as seconds since the first one."""

    def __init__(self, name: str, kind: pa.DataType) -> None:
        self.name, self.kind = name, kind
        self.origin: int | None = None

    @staticmethod
    def of(name: str, column: pa.Array) -> StampColumn | None:
        """Return such a column if every non-empty cell is a date with a time, else None."""
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
        """Read cells (rows,) in s; raise InvalidDataError with the row of the first that is not a time."""
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
    """Return the seconds since the first of some integer times, exact, and that first time; unit: in s."""
    ticks = pc.fill_null(pc.cast(stamps, pa.int64()), _INT_MIN).to_numpy(zero_copy_only=False)
    given = ticks != _INT_MIN
    if origin is None and given.any():
        origin = int(ticks[given.argmax()])
    seconds = np.full(len(ticks), np.nan)
    seconds[given] = (ticks[given] - (origin or 0)) * unit
    return seconds, origin


def _floats(column: pa.Array) -> Array:
    values: Array = column.to_numpy(zero_copy_only=False)
    return values


class Node(Protocol):
    """A reader that turns an Arrow column into columns of numbers."""

    names: list[str]
    units: dict[str, str]

    def read(self, array: pa.Array, first_row: int) -> list[Array]:
        """Return one array (rows,) per name, NaN if a value is missing; raise InvalidDataError that names the row."""


def plan(name: str, kind: pa.DataType, sample: pa.Array, widest: int) -> Node | None:
    """Return the reader of a column; None if it holds no numbers, or lists longer than `widest`.

    sample: some of its first rows, which show the length of its lists.
    """
    if isinstance(kind, pa.BaseExtensionType):
        return plan(name, kind.storage_type, _storage(sample), widest)
    if pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind):
        return _Number(name)
    if pa.types.is_timestamp(kind) or pa.types.is_duration(kind) or pa.types.is_time(kind):
        return _Time(name, kind)
    if pa.types.is_struct(kind):
        return _struct(name, kind, sample, widest)
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        width = kind.list_size if pa.types.is_fixed_size_list(kind) else _width(sample)
        items = sample.flatten()
        child = plan("", kind.value_type, items, widest) if 0 < width <= widest else None
        if child is not None and width * len(child.names) <= widest:
            return _List(name, width, child)
    return None


class _Number:
    """Numbers of any type."""

    def __init__(self, name: str) -> None:
        self.names, self.units = [name], dict[str, str]()

    def read(self, array: pa.Array, first_row: int) -> list[Array]:
        return [pc.cast(_storage(array), pa.float64(), safe=False).to_numpy(zero_copy_only=False)]


class _Time:
    """Times in s: stamps since the first one, durations and times of day as they are."""

    def __init__(self, name: str, kind: pa.DataType) -> None:
        self.names, self.units = [name], {name: "s"}
        self.unit = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[kind.unit]
        self.small = pa.types.is_time32(kind)
        self.origin = None if pa.types.is_timestamp(kind) else 0

    def read(self, array: pa.Array, first_row: int) -> list[Array]:
        times = pc.cast(array, pa.int32()) if self.small else array
        seconds, self.origin = since(times, self.origin, self.unit)
        return [seconds]


class _Struct:
    """Structures of named parts."""

    def __init__(self, parts: dict[int, Node]) -> None:
        self.parts = parts
        self.names = [name for part in parts.values() for name in part.names]
        self.units = {name: unit for part in parts.values() for name, unit in part.units.items()}

    def read(self, array: pa.Array, first_row: int) -> list[Array]:
        fields = _storage(array).flatten()  # all parts of a missing structure are missing
        return [column for index, part in self.parts.items() for column in part.read(fields[index], first_row)]


class _List:
    """Lists that have the same length in all rows."""

    def __init__(self, name: str, width: int, child: Node) -> None:
        self.name, self.width, self.child = name, width, child
        self.names = [f"{name}[{i}]{inner}" for i in range(width) for inner in child.names]
        inner = dict(child.units)
        self.units = {f"{name}[{i}]{each}": unit for i in range(width) for each, unit in inner.items()}

    def read(self, array: pa.Array, first_row: int) -> list[Array]:
        array = _storage(array)
        lengths = pc.fill_null(pc.list_value_length(array), -1).to_numpy(zero_copy_only=False)
        given = lengths > 0  # an empty list is a missing value
        wrong = np.flatnonzero(given & (lengths != self.width))
        if len(wrong):
            row, count = first_row + int(wrong[0]), int(lengths[wrong[0]])
            raise invalid_data(
                f"{self.name}, row {row}", f"a list of {count} values", f"{self.width} values, as in the rows before"
            )
        inner = self.child.read(array.flatten(), first_row)
        out = []
        for position in range(self.width):
            for column in inner:
                values = np.full(len(array), np.nan)
                values[given] = column[position :: self.width]
                out.append(values)
        return out


def _struct(name: str, kind: pa.DataType, sample: pa.Array, widest: int) -> Node | None:
    fields, parts, count = sample.flatten(), dict[int, Node](), 0
    for index in range(kind.num_fields):
        part = kind.field(index)
        node = plan(f"{name}.{part.name}", part.type, fields[index], widest)
        if node is not None:
            parts[index] = node
            count += len(node.names)
    return _Struct(parts) if parts and count <= widest else None


def _width(sample: pa.Array) -> int:
    """Return the usual length of lists, 0 if there is none."""
    lengths = pc.drop_null(pc.list_value_length(sample)).to_numpy()
    widths, counts = np.unique(lengths[lengths > 0], return_counts=True)
    return int(widths[counts.argmax()]) if len(widths) and counts.max() >= SAME_LENGTH * counts.sum() else 0


def _storage(array: pa.Array) -> pa.Array:
    return array.storage if isinstance(array, pa.ExtensionArray) else array

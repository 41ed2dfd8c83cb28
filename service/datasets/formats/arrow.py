"""Converting Arrow columns to columns of numbers: numbers, times, lists (`name[0]`) and structures (`name.part`)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lipcore.data.samples import Array
from service.datasets.formats.table import MAX_COLUMNS, SAME_LENGTH, describe_unread, stack_blocks
from service.foundation.errors import invalid_data

_INT_MIN = np.iinfo(np.int64).min


def since(stamps: pa.Array, origin: int | None, unit: float) -> tuple[Array, int | None]:
    """Return the seconds since the first of some integer times, exact, and that first time; unit: in s."""
    ticks = pc.fill_null(pc.cast(stamps, pa.int64()), _INT_MIN).to_numpy(zero_copy_only=False)
    given = ticks != _INT_MIN
    if origin is None and given.any():
        origin = int(ticks[given.argmax()])
    seconds = np.full(len(ticks), np.nan)
    seconds[given] = (ticks[given] - (origin or 0)) * unit
    return seconds, origin


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


@dataclass(frozen=True)
class ArrowColumns:
    """The columns of numbers in tables of one schema.

    nodes: reader of each top-level column; names: of all columns of numbers; units: by name; facts: for the report.
    """

    nodes: dict[str, Node]
    names: list[str]
    units: dict[str, str]
    facts: list[str]

    @classmethod
    def plan(
        cls,
        schema: pa.Schema,
        sample: pa.RecordBatch | None,
        rename: Callable[[str, list[str]], list[str]] | None = None,
    ) -> ArrowColumns:
        """Plan the reading of a schema.

        sample: the first rows of nested columns, which show the length of lists; rename: maps the name of a top-level
        column and the names of its columns to other names.
        """
        out, ignored = cls({}, [], {}, []), []
        for column in schema:
            first = pa.array([], _storage_type(column.type))
            if sample is not None and is_nested(column.type):
                first = sample.column(column.name)
            node = plan(column.name, column.type, first, MAX_COLUMNS)
            if node is None:
                ignored.append(column.name)
                continue
            names = rename(column.name, node.names) if rename else node.names
            metadata = column.metadata or {}
            if unit := metadata.get(b"unit") or metadata.get(b"units"):
                out.units.update(dict.fromkeys(names, unit.decode("utf-8", "replace")))
            pairs = zip(node.names, names, strict=True)
            out.units.update({new: node.units[old] for old, new in pairs if old in node.units})
            out.nodes[column.name] = node
            out.names.extend(names)
        out.facts.extend(describe_unread(ignored, "they hold no numbers, or lists of different lengths"))
        stamps = [each.name for each in schema if pa.types.is_timestamp(each.type)]
        out.facts.extend(f"{name} holds dates, which were converted to seconds since the first one" for name in stamps)
        return out

    def blocks(self, batches: Iterable[pa.RecordBatch]) -> Iterator[Array]:
        """Yield float64 (rows, columns) of batches of rows; raise InvalidDataError."""
        row = 1
        for batch in batches:
            if batch.num_rows and self.nodes:
                parts = [node.read(batch.column(name), row) for name, node in self.nodes.items()]
                yield from stack_blocks([column for columns in parts for column in columns])
                row += batch.num_rows


def is_nested(kind: pa.DataType) -> bool:
    """Return whether a column holds lists or structures."""
    return bool(pa.types.is_nested(_storage_type(kind)))


def _storage_type(kind: pa.DataType) -> pa.DataType:
    return kind.storage_type if isinstance(kind, pa.BaseExtensionType) else kind


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

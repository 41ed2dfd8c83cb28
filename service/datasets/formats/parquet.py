"""Reading Parquet: a batch of rows at a time, lists and structures flattened.

Arrow takes as much memory for a page as the page's own header says that it unpacks to, up to 2 GiB for each column at
once, whatever the footer says. So the headers are read before Arrow reads the pages.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import pyarrow as pa
import pyarrow.parquet as pq

from lipcore.data.samples import Array
from service.datasets.formats.arrow import Node, plan
from service.datasets.formats.table import Table, block_rows, checked_names, first_line, left_out, stacked
from service.datasets.options import ReadOptions
from service.foundation.errors import TooLargeError, invalid_data
from service.foundation.settings import Settings

EXPECTED = "a complete Parquet file"
ERRORS = (pa.ArrowException, OSError, ValueError, EOFError, MemoryError)
SAMPLE_ROWS = 64
"""Rows that tell how long lists are."""
BUFFER_BYTES = 64 * 1024
MAX_FOOTER = 16 * 1024 * 1024
MAX_PAGE = 64 * 1024 * 1024
"""Largest page once unpacked; writers make them of about 1 MiB."""
MAX_PAGES = 200_000
HEADER_BYTES = (64, 4096, 1024 * 1024)
"""What is read of a page for its header: statistics may make it long."""
_INT32, _BINARY, _STRUCT, _PLAIN_KINDS = 5, 8, 12, {1: 0, 2: 0, 3: 1, 7: 8}
"""Kinds of Thrift's compact protocol; those of fixed size with the bytes that follow (of a truth value none)."""


@contextmanager
def open_parquet(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open a Parquet file as a table; raise InvalidDataError naming what is wrong, or TooLargeError.

    Columns that hold no numbers are left out, which is a fact of the table; stamps become seconds since the first.
    """
    with path.open("rb") as file:
        source = ParquetSource(file, settings)
        yield Table(checked_names(source.names, settings), source.blocks(), units=source.units, facts=source.facts)


class ParquetSource:
    """An open Parquet file: names and units of its columns of numbers, and their blocks, to be read once.

    rename: what a top-level column is called, (name, names of its columns) → other names.
    """

    def __init__(
        self, file: IO[bytes], settings: Settings, rename: Callable[[str, list[str]], list[str]] | None = None
    ) -> None:
        try:
            check_pages(file, settings)
            file.seek(0)
            self._file = pq.ParquetFile(file, buffer_size=BUFFER_BYTES, pre_buffer=False, memory_map=False)
            schema = self._file.schema_arrow
            checked_names(schema.names, settings)
            nested = [each.name for each in schema if pa.types.is_nested(_storage_type(each.type))]
            batches = self._file.iter_batches(SAMPLE_ROWS, columns=nested, use_threads=False) if nested else iter(())
            sample = next(batches, None)
        except ERRORS as error:
            raise invalid_data("file", first_line(error), EXPECTED) from None
        self._nodes: dict[str, Node] = {}
        self.names: list[str] = []
        self.units: dict[str, str] = {}
        ignored = []
        for column in schema:
            first = pa.array([], _storage_type(column.type))
            if sample is not None and column.name in nested:
                first = sample.column(column.name)
            node = plan(column.name, column.type, first, settings.max_columns)
            if node is None:
                ignored.append(column.name)
                continue
            self._nodes[column.name] = node
            names = rename(column.name, node.names) if rename else node.names
            metadata = column.metadata or {}
            if unit := metadata.get(b"unit") or metadata.get(b"units"):
                self.units |= dict.fromkeys(names, unit.decode("utf-8", "replace"))
            self.units |= {
                new: node.units[old] for old, new in zip(node.names, names, strict=True) if old in node.units
            }
            self.names += names
        self.facts = left_out(ignored, "they hold no numbers, or lists of different lengths")
        stamps = [each.name for each in schema if pa.types.is_timestamp(each.type)]
        self.facts += [f"{name} holds dates: read as seconds since its first" for name in stamps]

    def blocks(self) -> Iterator[Array]:
        """float64 (rows, columns); raise InvalidDataError."""
        if not self._nodes:
            return
        row, step = 1, block_rows(len(self.names))
        try:
            for batch in self._file.iter_batches(step, columns=list(self._nodes), use_threads=False):
                if batch.num_rows:
                    parts = [node.read(batch.column(name), row) for name, node in self._nodes.items()]
                    yield from stacked([column for columns in parts for column in columns])
                    row += batch.num_rows
        except ERRORS as error:
            raise invalid_data("file", first_line(error), EXPECTED) from None


def _storage_type(kind: pa.DataType) -> pa.DataType:
    return kind.storage_type if isinstance(kind, pa.BaseExtensionType) else kind


def check_pages(file: IO[bytes], settings: Settings) -> None:
    """Raise InvalidDataError or TooLargeError where the footer or a page is larger than any writer makes them."""
    size = file.seek(0, 2)
    if size < 12:
        raise invalid_data("file", f"{size} bytes", EXPECTED)
    file.seek(-8, 2)
    footer, magic = struct.unpack("<I4s", file.read(8))
    if magic != b"PAR1":
        raise invalid_data("file", "cut off", EXPECTED)
    if footer > min(MAX_FOOTER, size - 8):
        raise invalid_data("file", f"a footer of {footer} bytes", f"{EXPECTED}, with at most {MAX_FOOTER}")
    file.seek(0)
    meta = pq.read_metadata(file)
    limit, total, pages = settings.max_unpacked_bytes, 0, 0
    for group in map(meta.row_group, range(meta.num_row_groups)):
        for column in map(group.column, range(meta.num_columns)):
            if column.num_values == group.num_rows == 0:
                continue  # nothing is read, wherever it is said to be
            name, start = column.path_in_schema, column.data_page_offset
            if column.dictionary_page_offset is not None and 0 < column.dictionary_page_offset < start:
                start = column.dictionary_page_offset
            end = start + column.total_compressed_size
            if not 4 <= start <= end <= size:
                raise invalid_data(name, f"at bytes {start} to {end}", f"within the {size} of the file")
            while start < end:
                unpacked, packed, start = _page(file, start)
                pages += 1
                total += max(unpacked, 0)
                if not 0 <= unpacked <= MAX_PAGE or packed < 0 or pages > MAX_PAGES:
                    expected = f"at most {MAX_PAGES} pages of {MAX_PAGE}"
                    raise invalid_data(name, f"page {pages} of {unpacked} bytes", expected)
                if total > limit:
                    raise TooLargeError(f"the file unpacks to more than {limit} bytes, expected at most {limit}")
                start += packed


def _page(file: IO[bytes], start: int) -> tuple[int, int, int]:
    """Sizes of the page at a byte, unpacked and packed, and where its header ends."""
    for size in HEADER_BYTES:
        file.seek(start)
        try:
            fields, length = _structure(file.read(size), 0)
        except IndexError:
            continue
        if 2 in fields and 3 in fields:
            return fields[2], fields[3], start + length
        break
    raise invalid_data("file", f"no page at byte {start}", EXPECTED)


def _structure(data: bytes, at: int, depth: int = 0) -> tuple[dict[int, int], int]:
    """Numbers of 32 bits by field of a structure in Thrift's compact protocol, and where it ends.

    https://github.com/apache/thrift/blob/master/doc/specs/thrift-compact-protocol.md. Raise IndexError where it goes on
    beyond the data, ValueError for what no page's header has.
    """
    fields: dict[int, int] = {}
    field = 0
    while (head := data[at]) != 0:
        at += 1
        kind, step = head & 15, head >> 4
        if step:
            field += step
        else:
            field, at = _number(data, at)
        field &= 0xFFFF  # as Arrow counts them
        if kind in _PLAIN_KINDS:
            at += _PLAIN_KINDS[kind]
        elif kind == _STRUCT and depth < 8:
            _, at = _structure(data, at, depth + 1)
        elif kind == _BINARY:
            length, at = _unsigned(data, at)
            at += length
        elif kind in (4, _INT32, 6):
            value, at = _number(data, at)
            if kind == _INT32:  # Arrow passes over a field of another kind
                fields[field] = value
        else:
            raise ValueError(f"a page's header of kind {kind}")
    return fields, at + 1


def _unsigned(data: bytes, at: int) -> tuple[int, int]:
    """A number of seven bits a byte, and where it ends."""
    value = 0
    for shift in range(0, 70, 7):
        byte = data[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
    raise ValueError("a number of too many bytes")


def _number(data: bytes, at: int) -> tuple[int, int]:
    """The same with a sign."""
    value, at = _unsigned(data, at)
    return (value >> 1) ^ -(value & 1), at

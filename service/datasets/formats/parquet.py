"""Reading Parquet in batches of rows; lists and structures become columns.

For each column, Arrow allocates the unpacked size that a page's header declares, up to 2 GiB. Files from strangers must
therefore be read in a process with limited memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import pyarrow as pa
import pyarrow.parquet as pq

from lipcore.data.samples import Array
from service.datasets.formats.arrow import Node, plan
from service.datasets.formats.table import (
    MAX_COLUMNS,
    Table,
    block_rows,
    clean_names,
    describe_unread,
    first_line,
    stack_blocks,
    unreadable,
)
from service.datasets.options import ReadOptions
from service.foundation.errors import TooLargeError
from service.foundation.settings import Settings

EXPECTED = "a complete Parquet file"
ERRORS = (pa.ArrowException, OSError, ValueError, EOFError, MemoryError)


@contextmanager
def open_parquet(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open a Parquet file as a table; raise InvalidDataError or TooLargeError.

    Columns without numbers are not read, and the table's facts say so. Stamps become seconds since the first one.
    """
    with path.open("rb") as file:
        source = ParquetSource(file, settings)
        yield Table(clean_names(source.names), source.blocks(), units=source.units, facts=source.facts)


class ParquetSource:
    """An open Parquet file with the names and units of its numeric columns; its blocks can be read once.

    rename: maps the name of a top-level column and the names of its columns to other names.
    """

    def __init__(
        self, file: IO[bytes], settings: Settings, rename: Callable[[str, list[str]], list[str]] | None = None
    ) -> None:
        try:
            self._file = pq.ParquetFile(file, buffer_size=64 * 1024, pre_buffer=False, memory_map=False)
            groups = map(self._file.metadata.row_group, range(self._file.metadata.num_row_groups))
            if (size := sum(each.total_byte_size for each in groups)) > settings.max_unpacked_bytes:
                raise TooLargeError(f"The file unpacks to {size} bytes, expected at most {settings.max_unpacked_bytes}")
            schema = self._file.schema_arrow
            clean_names(schema.names)
            nested = [each.name for each in schema if pa.types.is_nested(_storage_type(each.type))]
            # the first rows show the length of lists
            batches = self._file.iter_batches(64, columns=nested, use_threads=False) if nested else iter(())
            sample = next(batches, None)
        except ERRORS as error:
            text = first_line(error)
            text = "cut off before its end" if "not found in footer" in text else text
            raise unreadable("file", text, EXPECTED) from None
        self._nodes: dict[str, Node] = {}
        self.names: list[str] = []
        self.units: dict[str, str] = {}
        ignored = []
        for column in schema:
            first = pa.array([], _storage_type(column.type))
            if sample is not None and column.name in nested:
                first = sample.column(column.name)
            node = plan(column.name, column.type, first, MAX_COLUMNS)
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
        self.facts = describe_unread(ignored, "they hold no numbers, or lists of different lengths")
        stamps = [each.name for each in schema if pa.types.is_timestamp(each.type)]
        self.facts += [f"{name} holds dates, which were converted to seconds since the first one" for name in stamps]

    def blocks(self) -> Iterator[Array]:
        """Yield float64 (rows, columns); raise InvalidDataError."""
        if not self._nodes:
            return
        row, step = 1, block_rows(len(self.names))
        try:
            for batch in self._file.iter_batches(step, columns=list(self._nodes), use_threads=False):
                if batch.num_rows:
                    parts = [node.read(batch.column(name), row) for name, node in self._nodes.items()]
                    yield from stack_blocks([column for columns in parts for column in columns])
                    row += batch.num_rows
        except ERRORS as error:
            raise unreadable("file", first_line(error), EXPECTED) from None


def _storage_type(kind: pa.DataType) -> pa.DataType:
    return kind.storage_type if isinstance(kind, pa.BaseExtensionType) else kind

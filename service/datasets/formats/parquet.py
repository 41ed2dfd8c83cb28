"""Reading Parquet: a batch of rows at a time, lists and structures flattened.

Arrow takes as much memory for a page as the page's own header says that it unpacks to, up to 2 GiB for each column at
once: for a file from a stranger to be read in a process whose memory is limited.
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
from service.datasets.formats.table import MAX_COLUMNS, Table, block_rows, checked_names, first_line, left_out, stacked
from service.datasets.options import ReadOptions
from service.foundation.errors import TooLargeError, invalid_data
from service.foundation.settings import Settings

EXPECTED = "a complete Parquet file"
ERRORS = (pa.ArrowException, OSError, ValueError, EOFError, MemoryError)


@contextmanager
def open_parquet(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open a Parquet file as a table; raise InvalidDataError naming what is wrong, or TooLargeError.

    Columns that hold no numbers are left out, which is a fact of the table; stamps become seconds since the first.
    """
    with path.open("rb") as file:
        source = ParquetSource(file, settings)
        yield Table(checked_names(source.names), source.blocks(), units=source.units, facts=source.facts)


class ParquetSource:
    """An open Parquet file: names and units of its columns of numbers, and their blocks, to be read once.

    rename: what a top-level column is called, (name, names of its columns) → other names.
    """

    def __init__(
        self, file: IO[bytes], settings: Settings, rename: Callable[[str, list[str]], list[str]] | None = None
    ) -> None:
        try:
            self._file = pq.ParquetFile(file, buffer_size=64 * 1024, pre_buffer=False, memory_map=False)
            groups = map(self._file.metadata.row_group, range(self._file.metadata.num_row_groups))
            if (size := sum(each.total_byte_size for each in groups)) > settings.max_unpacked_bytes:
                raise TooLargeError(f"the file unpacks to {size} bytes, expected at most {settings.max_unpacked_bytes}")
            schema = self._file.schema_arrow
            checked_names(schema.names)
            nested = [each.name for each in schema if pa.types.is_nested(_storage_type(each.type))]
            # a few rows tell how long lists are
            batches = self._file.iter_batches(64, columns=nested, use_threads=False) if nested else iter(())
            sample = next(batches, None)
        except ERRORS as error:
            text = first_line(error)
            raise invalid_data("file", "cut off" if "not found in footer" in text else text, EXPECTED) from None
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

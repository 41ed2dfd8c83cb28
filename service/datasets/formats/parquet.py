"""Reading Parquet: a batch of rows at a time, lists and structures flattened."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import pyarrow as pa
import pyarrow.parquet as pq

from lipcore.data.samples import Array
from service.datasets.formats.blocks import block_rows, checked_names, guarded, left_out, said, stacked
from service.datasets.formats.flattening import Node, plan
from service.datasets.formats.parquet_pages import check_pages
from service.datasets.formats.table import Table
from service.datasets.options import ReadOptions
from service.foundation.errors import invalid_data
from service.foundation.settings import Settings

EXPECTED = "a complete Parquet file"
ERRORS = (pa.ArrowException, OSError, ValueError, EOFError, MemoryError)
SAMPLE_ROWS = 64
"""Rows that tell how long lists are."""
BUFFER_BYTES = 64 * 1024


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
            nested = [each.name for each in schema if pa.types.is_nested(_plain(each.type))]
            batches = self._file.iter_batches(SAMPLE_ROWS, columns=nested, use_threads=False) if nested else iter(())
            sample = next(batches, None)
        except ERRORS as error:
            raise invalid_data("file", said(error), EXPECTED) from None
        self._nodes: dict[str, Node] = {}
        self.names: list[str] = []
        self.units: dict[str, str] = {}
        ignored = []
        for column in schema:
            first = pa.array([], _plain(column.type))
            if sample is not None and column.name in nested:
                first = sample.column(column.name)
            node = plan(column.name, column.type, first, settings.max_columns)
            if node is None:
                ignored.append(column.name)
                continue
            self._nodes[column.name] = node
            names = rename(column.name, node.names) if rename else node.names
            said_unit = (column.metadata or {}).get(b"unit") or (column.metadata or {}).get(b"units")
            if said_unit:
                self.units |= dict.fromkeys(names, said_unit.decode("utf-8", "replace"))
            self.units |= {
                new: node.units[old] for old, new in zip(node.names, names, strict=True) if old in node.units
            }
            self.names += names
        self.facts = left_out(ignored, "they hold no numbers, or lists of different lengths")
        stamps = [each.name for each in schema if pa.types.is_timestamp(each.type)]
        self.facts += [f"{name} holds dates: read as seconds since its first" for name in stamps]

    def blocks(self) -> Iterator[Array]:
        """float64 (rows, columns)."""
        if not self._nodes:
            return iter(())
        return guarded(self._read(), (pa.ArrowException, OSError, ValueError, EOFError, MemoryError), EXPECTED)

    def _read(self) -> Iterator[Array]:
        row = 1
        step = block_rows(len(self.names))
        for batch in self._file.iter_batches(step, columns=list(self._nodes), use_threads=False):
            if batch.num_rows:
                columns = [part for name, node in self._nodes.items() for part in node.read(batch.column(name), row)]
                yield from stacked(columns)
                row += batch.num_rows


def _plain(kind: pa.DataType) -> pa.DataType:
    return kind.storage_type if isinstance(kind, pa.BaseExtensionType) else kind

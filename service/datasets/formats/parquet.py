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
from service.datasets.formats.arrow import ArrowColumns, is_nested
from service.datasets.formats.table import Table, block_rows, clean_names, first_line, unreadable
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
            nested = [each.name for each in schema if is_nested(each.type)]
            # the first rows show the length of lists
            batches = self._file.iter_batches(64, columns=nested, use_threads=False) if nested else iter(())
            sample = next(batches, None)
        except ERRORS as error:
            text = first_line(error)
            text = "cut off before its end" if "not found in footer" in text else text
            raise unreadable("file", text, EXPECTED) from None
        self.columns = ArrowColumns.plan(schema, sample, rename)
        self.names, self.units, self.facts = self.columns.names, self.columns.units, self.columns.facts

    def blocks(self) -> Iterator[Array]:
        """Yield float64 (rows, columns); raise InvalidDataError."""
        step, names = block_rows(len(self.names)), list(self.columns.nodes)
        try:
            if names:
                yield from self.columns.blocks(self._file.iter_batches(step, columns=names, use_threads=False))
        except ERRORS as error:
            raise unreadable("file", first_line(error), EXPECTED) from None

"""Reading Feather (Arrow IPC files) in batches of rows; lists and structures become columns as in Parquet."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa

from lipcore.data.samples import Array
from service.datasets.formats.arrow import ArrowColumns
from service.datasets.formats.parquet import ERRORS
from service.datasets.formats.table import Table, clean_names, first_line, unreadable
from service.datasets.options import ReadOptions
from service.foundation.errors import TooLargeError
from service.foundation.settings import Settings

EXPECTED = "a complete Feather file, version 2"


@contextmanager
def open_feather(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open a Feather file as a table; raise InvalidDataError or TooLargeError."""
    with path.open("rb") as file:
        try:
            reader = pa.ipc.open_file(file)
            clean_names(reader.schema.names)
            sample = reader.get_batch(0) if reader.num_record_batches else None
        except ERRORS as error:
            raise unreadable("file", first_line(error), EXPECTED) from None
        columns = ArrowColumns.plan(reader.schema, sample)
        yield Table(clean_names(columns.names), _blocks(reader, columns, settings), None, columns.units, columns.facts)


def _blocks(reader: pa.RecordBatchFileReader, columns: ArrowColumns, settings: Settings) -> Iterator[Array]:
    size = 0

    def batches() -> Iterator[pa.RecordBatch]:
        nonlocal size
        for number in range(reader.num_record_batches):
            batch = reader.get_batch(number)
            size += batch.nbytes
            if size > settings.max_unpacked_bytes:
                raise TooLargeError(f"The file unpacks to more than {settings.max_unpacked_bytes} bytes")
            yield batch

    try:
        yield from columns.blocks(batches())
    except ERRORS as error:
        raise unreadable("file", first_line(error), EXPECTED) from None

"""Writing and reading uploads in tests."""

import io
import zipfile
from dataclasses import dataclass
from functools import cache

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from service.datasets.formats.opening import open_table
from service.datasets.formats.table import BLOCK_ROWS
from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError, ServiceError
from service.foundation.settings import Settings


def zipped(files, compression=zipfile.ZIP_DEFLATED):
    """Return a zip archive of contents by name."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", compression) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return out.getvalue()


def parquet(table, **options):
    """Return a Parquet file of a table, or of columns by name."""
    out = io.BytesIO()
    pq.write_table(table if isinstance(table, pa.Table) else pa.table(table), out, **options)
    return out.getvalue()


@dataclass
class Read:
    """The contents of a table: columns by name, units, facts and joint names."""

    columns: dict[str, np.ndarray]
    units: dict[str, str]
    facts: list[str]
    joint_names: tuple[str, ...] | None

    def __getitem__(self, name):
        return self.columns[name]

    @property
    def names(self):
        return tuple(self.columns)

    @property
    def rows(self):
        return np.column_stack(list(self.columns.values()))


def read_blocks(table):
    """Read the blocks of a table and check the properties of every table."""
    blocks = list(table.blocks)
    for block in blocks:
        assert block.dtype == np.float64
        assert 1 <= len(block) <= BLOCK_ROWS
        assert block.shape == (len(block), len(table.names))
    assert len(set(table.names)) == len(table.names)
    entire = np.concatenate(blocks) if blocks else np.empty((0, len(table.names)))
    return Read(dict(zip(table.names, entire.T, strict=True)), table.units, table.facts, table.joint_names)


@cache
def settings_of(folder, **changed):
    return Settings(home=folder, **changed)


def read(folder, body, kind, options=None, **settings):
    """Read an upload and check that it leaves no files."""
    path = folder / "upload"
    path.write_bytes(body)
    before = set(folder.iterdir())
    with open_table(path, kind, options or ReadOptions(), settings_of(folder, **settings)) as table:
        result = read_blocks(table)
    assert set(folder.iterdir()) == before, "leftovers"
    return result


def read_rejected(folder, body, kind, options=None, error=ServiceError, **settings):
    """Read an upload that is rejected; return (field, value, expected), or the message without a detail."""
    before = set(folder.iterdir())
    with pytest.raises(error) as caught:
        read(folder, body, kind, options, **settings)
    assert set(folder.iterdir()) <= before | {folder / "upload"}, "leftovers"
    detail = caught.value.detail
    return (detail[0].field, detail[0].value, detail[0].expected) if detail else caught.value.message


def check_rejected(folder, body, kind, field, words="", options=None, error=InvalidDataError, **settings):
    """Check the field of a rejection; and a text in its detail, or its value and expected as a tuple."""
    reply = read_rejected(folder, body, kind, options, error, **settings)
    assert reply[0] == field
    assert words in " ".join(reply) if isinstance(words, str) else reply[1 : 1 + len(words)] == words
    return reply

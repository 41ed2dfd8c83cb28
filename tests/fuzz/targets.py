"""Targets of fuzzing: the readers of files from strangers. Any result is correct except an unexpected error.

Checksums are not compared, because nearly every changed file would stop there.
"""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

from mcap import data_stream, stream_reader

from lipcore.files.manifest import DEFAULT_LIMITS, ModelFormatError, read_manifest_bytes
from lipcore.files.tensors import read_tensors
from lipcore.profiles import from_urdf
from service.datasets.caged import read_upload
from service.datasets.mapping.reading import read
from service.datasets.options import UploadOptions
from service.foundation.errors import ServiceError
from service.foundation.settings import Settings
from service.models.archive_reading import try_out
from service.robots.caged import read_robot
from service.storage.disk import Usage

MiB = 1024 * 1024
SETTINGS = Settings(max_samples=5000, max_unpacked_bytes=16 * MiB)
SMALL = {
    "caged.read": partial(read, min_samples=10),
    "formats.table.MAX_COLUMNS": 200,
    "formats.json.MAX_COLUMNS": 200,
    "formats.npz.MAX_COLUMNS": 200,
    **{f"formats.{name}.MAX_COLUMNS": 200 for name in ("arrow", "csv", "transposed", "workbook")},
    "formats.zips.MAX_MEMBERS": 50,
    "formats.bags.decoding.MAX_SEQUENCE": 5000,
    "formats.json.MAX_BYTES": MiB,
    "formats.json.MAX_LINE_BYTES": 64 * 1024,
    "formats.opening.MAX_LINE_BYTES": 64 * 1024,
}
"""Small limits of recordings, to keep each run short."""
NOT_SURE = {"encoding": None, "confidence": 0.0}
"""What chardet finds here: it keeps 20 kB of each call, which matters only in one long process."""
USAGE = Usage(0, 1 << 40, None, 0)
JOINTS = 2
"""Joints of the models whose tensors are read."""


class _Sum(int):
    """A checksum that equals any other."""

    def __ne__(self, other: object) -> bool:
        return False


_NO_SUMS = SimpleNamespace(crc32=lambda *_: _Sum())


def _recording(kind: str) -> Callable[[bytes], None]:
    """Return a reader of recordings that are sent as this kind."""

    def read_bytes(data: bytes) -> None:
        with tempfile.TemporaryDirectory() as folder, patch.object(zipfile.ZipExtFile, "_update_crc", lambda *_: None):
            path = Path(folder) / "upload"
            path.write_bytes(data)
            with patch("chardet.detect", return_value=NOT_SURE), ExitStack() as small:
                for module in (stream_reader, data_stream):
                    small.enter_context(patch.object(module, "zlib", _NO_SUMS))
                for place, value in SMALL.items():
                    small.enter_context(patch(f"service.datasets.{place}", value))
                read_upload(path, kind, UploadOptions(), None, USAGE, Path(folder), SETTINGS)

    return read_bytes


def _urdf(data: bytes) -> None:
    for scale in ({}, {"length": 0.5, "mass": 2.0, "inertia": 0.1}):
        with tempfile.TemporaryDirectory() as folder:
            upload = Path(folder) / "upload"
            upload.write_bytes(data)
            robot = read_robot(upload, scale, {}, Path(folder), MiB)
        from_urdf(robot.urdf, "fuzzed")  # a robot that can be read can also be used


def _archive(data: bytes) -> None:
    with tempfile.NamedTemporaryFile() as file:
        file.write(data)
        file.flush()
        try_out(Path(file.name), SETTINGS)


def _tensors(data: bytes) -> None:
    read_tensors(data, JOINTS, DEFAULT_LIMITS)


KINDS = ("csv", "json", "json_lines", "npz", "parquet", "rosbag1", "rosbag2", "mcap", "zip")
KINDS += (
    "feather",
    "hdf5",
    "npy",
    "xlsx",
    "gzip",
    "yaml",
)  # SciPy crashes on damaged `mat` files, in the confined process
TARGETS: dict[str, Callable[[bytes], object]] = {
    **{kind: _recording(kind) for kind in KINDS},
    "urdf": _urdf,
    "archive": _archive,
    "manifest": read_manifest_bytes,
    "tensors": _tensors,
}
"""Readers by name."""


def run(target: str, data: bytes) -> bool:
    """Read bytes; return whether they could be read. Raise any error that is not one of the service."""
    try:
        TARGETS[target](data)
    except (ServiceError, ModelFormatError):
        return False
    return True

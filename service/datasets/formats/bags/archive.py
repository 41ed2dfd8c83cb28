"""A bag that is a folder, uploaded as a zip: its files are checked, and unpacked under names of our own."""

from __future__ import annotations

import errno
import re
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

import pyarrow as pa

from service.datasets.formats.bags.container import damaged
from service.datasets.formats.blocks import said
from service.datasets.formats.zips import ERRORS, measure, open_zip
from service.foundation.errors import TooLargeError, invalid_data
from service.foundation.settings import Settings

PIECE = 1024 * 1024
SUFFIXES = (".db3", ".mcap", ".bag", ".db3.zstd", ".mcap.zstd")


@contextmanager
def unpacked(path: Path, settings: Settings) -> Iterator[list[Path]]:
    """The files of a zipped bag in the order of their recording, in a folder that is removed at the end.

    Raise InvalidDataError, or TooLargeError.
    """
    with TemporaryDirectory(dir=path.parent) as folder:
        with open_zip(path, settings, "a complete zip archive") as archive:
            try:
                files = _unpack(archive, Path(folder), settings)
            except ERRORS as error:
                if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
                    raise  # of our disk, not of the archive
                raise invalid_data("file", said(error), "a complete zip archive") from None
        yield files


def _unpack(archive: zipfile.ZipFile, folder: Path, settings: Settings) -> list[Path]:
    members = _checked(archive, settings)
    files = []
    room = settings.max_unpacked_bytes
    for index, member in enumerate(members):
        file = folder / f"{index}.bag"
        packed = member.filename.endswith(".zstd")
        with archive.open(member) as source, file.open("xb") as target:
            stream = pa.CompressedInputStream(pa.PythonFile(source, "r"), "zstd") if packed else source
            while piece := stream.read(PIECE):
                room -= len(piece)
                if room < 0:
                    raise TooLargeError(f"the archive unpacks to more than {settings.max_unpacked_bytes} bytes")
                target.write(piece)
        files.append(file)
    return files


def _checked(archive: zipfile.ZipFile, settings: Settings) -> list[zipfile.ZipInfo]:
    members = [member for member in archive.infolist() if member.filename.endswith(SUFFIXES)]
    if not members:
        raise damaged(f"an archive without a file named {', '.join(SUFFIXES)}")
    measure(members, settings)
    if len(folders := sorted({str(PurePosixPath(member.filename).parent) for member in members})) > 1:
        raise invalid_data("file", f"bags in folders {', '.join(folders[:5])}", "one bag")
    return sorted(members, key=lambda member: _order(member.filename))


def _order(name: str) -> tuple[list[int], str]:
    """Recorders number the files that they split a recording into: name_0.db3, name_1.db3 …, name_10.db3."""
    stem = PurePosixPath(name).name.split(".")[0]
    return [int(number) for number in re.findall(r"[0-9]{1,18}", stem)[-1:]], name

"""Zip archives from strangers: measured before anything is unpacked, and never unpacked by the names they give."""

from __future__ import annotations

import errno
import re
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import IO, Any

from lipcore.extras import import_extra
from service.datasets.formats.table import first_line
from service.foundation.errors import ServiceError, TooLargeError, invalid_data
from service.foundation.settings import Settings

PIECE = 1024 * 1024
MAX_MEMBERS = 20_000
"""Files in an archive of recordings."""
ERRORS = (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, RuntimeError, ValueError)
"""What zipfile raises of a damaged archive: RuntimeError of a password, NotImplementedError of other compressions."""
BAG_ENDINGS = (".db3", ".mcap", ".bag", ".db3.zstd", ".mcap.zstd")
"""Names of the files of a bag."""
_COMPLETE = "a complete zip archive"


@contextmanager
def open_zip(path: Path, expected: str) -> Iterator[zipfile.ZipFile]:
    """Open an archive whose members have plain names, each once; raise InvalidDataError of any other."""
    with path.open("rb") as file:
        try:
            archive = zipfile.ZipFile(file)
        except ERRORS as error:
            text = first_line(error)
            raise invalid_data("file", "no zip archive" if "not a zip file" in text else text, expected) from None
        with archive:
            members = archive.infolist()
            if len(members) > MAX_MEMBERS:
                raise invalid_data("file", f"{len(members)} members", f"at most {MAX_MEMBERS}")
            seen: set[str] = set()
            for member in members:
                name = member.orig_filename
                if not name.isprintable() or "\\" in name or name.startswith("/") or ".." in name.split("/"):
                    raise invalid_data("member", name, "a plain name below the archive's folder")
                if name in seen:
                    raise invalid_data("member", name, "every member once")
                seen.add(name)
            yield archive


INFO = "meta/info.json"
"""What tells a LeRobot data set from other archives."""


def root_of(names: list[str]) -> str | None:
    """Folder of a LeRobot data set within an archive: "" or "name/"; None where there is none."""
    roots = [name.removesuffix(INFO) for name in names if name == INFO or name.endswith(f"/{INFO}")]
    return min(roots, key=len) if roots and min(roots, key=len).count("/") <= 1 else None


def measure(members: list[zipfile.ZipInfo], settings: Settings) -> None:
    """Raise TooLargeError where members unpack to more than the limit; zipfile never yields more than they say."""
    for member in members:
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise invalid_data(
                "member", f"{member.filename} compressed by method {member.compress_type}", "stored or deflated"
            )
    total = sum(member.file_size for member in members)
    if total > settings.max_unpacked_bytes:
        raise TooLargeError(f"the archive unpacks to {total} bytes, expected at most {settings.max_unpacked_bytes}")


def within(member: str, error: ServiceError) -> ServiceError:
    """An error of a member of an archive, which names it."""
    if isinstance(error, TooLargeError) or not error.detail:
        return error
    wrong = error.detail[0]
    return invalid_data(f"{member}: {wrong.field}", wrong.value, wrong.expected)


def by_numbers(name: str) -> list[int]:
    """What names are sorted by whose writers number their files: chunk_0/file_2, …, chunk_0/file_10."""
    return [int(number) for number in re.findall(r"[0-9]{1,18}", name)]


@contextmanager
def unpacked_bag(path: Path, settings: Settings) -> Iterator[list[Path]]:
    """The files of a zipped bag in the order of their recording, in a folder that is removed at the end.

    They have names of our own there. Raise InvalidDataError, or TooLargeError.
    """
    with TemporaryDirectory(dir=path.parent) as folder:
        with open_zip(path, _COMPLETE) as archive:
            try:
                files = _unpack(archive, Path(folder), settings)
            except ERRORS as error:
                if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
                    raise  # of our disk, not of the archive
                raise invalid_data("file", first_line(error), _COMPLETE) from None
        yield files


def _unpack(archive: zipfile.ZipFile, folder: Path, settings: Settings) -> list[Path]:
    files = []
    room = settings.max_unpacked_bytes
    for index, member in enumerate(_bag_members(archive, settings)):
        file = folder / f"{index}.bag"
        packed = member.filename.endswith(".zstd")
        with archive.open(member) as source, file.open("xb") as target:
            stream = _unpacked(source) if packed else source
            while piece := stream.read(PIECE):
                room -= len(piece)
                if room < 0:
                    raise TooLargeError(f"the archive unpacks to more than {settings.max_unpacked_bytes} bytes")
                target.write(piece)
        files.append(file)
    return files


def _unpacked(source: IO[bytes]) -> Any:
    pa = import_extra("pyarrow", "ingest")
    return pa.CompressedInputStream(pa.PythonFile(source, "r"), "zstd")


def _bag_members(archive: zipfile.ZipFile, settings: Settings) -> list[zipfile.ZipInfo]:
    """The files of one bag; recorders number those that they split a recording into: name_0.db3, …, name_10.db3."""
    members = [member for member in archive.infolist() if member.filename.endswith(BAG_ENDINGS)]
    if not members:
        raise invalid_data("file", f"an archive without a file named {', '.join(BAG_ENDINGS)}", "a complete bag")
    measure(members, settings)
    if len(folders := sorted({str(PurePosixPath(member.filename).parent) for member in members})) > 1:
        raise invalid_data("file", f"bags in folders {', '.join(folders[:5])}", "one bag")
    return sorted(
        members, key=lambda each: (by_numbers(PurePosixPath(each.filename).name.split(".")[0])[-1:], each.filename)
    )

"""Zip archives from strangers: sizes are checked before unpacking, and their file names are never used on disk."""

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
from service.datasets.formats.table import first_line, unreadable
from service.foundation.errors import ServiceError, TooLargeError, invalid_data, readable, sentence
from service.foundation.settings import Settings

COPY_BYTES = 1024 * 1024
MAX_MEMBERS = 20_000
"""Max files in an archive of recordings."""
ERRORS = (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, RuntimeError, ValueError)
"""Errors of zipfile: RuntimeError if there is a password, NotImplementedError for other compressions."""
BAG_ENDINGS = (".db3", ".mcap", ".bag", ".db3.zstd", ".mcap.zstd")
"""Endings of the file names of a bag."""
_COMPLETE = "a complete zip archive"


@contextmanager
def open_zip(path: Path, expected: str) -> Iterator[zipfile.ZipFile]:
    """Open a zip archive; raise InvalidDataError if a member's name is repeated or not a plain path."""
    with path.open("rb") as file:
        try:
            archive = zipfile.ZipFile(file)
        except ERRORS as error:
            text = first_line(error)
            raise unreadable("file", "not a zip archive" if "not a zip file" in text else text, expected) from None
        with archive:
            members = archive.infolist()
            if len(members) > MAX_MEMBERS:
                value, expected = f"{len(members)} members", f"at most {MAX_MEMBERS}"
                raise invalid_data("file", value, expected, f"The archive has {value}, expected {expected}.")
            seen: set[str] = set()
            for member in members:
                name = member.orig_filename
                if (
                    not name
                    or not name.isprintable()
                    or "\\" in name
                    or name.startswith("/")
                    or ".." in name.split("/")
                ):
                    raise invalid_data("member", name, "a plain path inside the archive")
                if name in seen:
                    raise invalid_data("member", name, "each member only once")
                seen.add(name)
            yield archive


INFO_PATH = "meta/info.json"
"""The file that only LeRobot data sets have."""


def find_lerobot_folder(names: list[str]) -> str | None:
    """Return the folder of a LeRobot data set in an archive, "" or "name/"; None if there is none."""
    roots = [name.removesuffix(INFO_PATH) for name in names if name == INFO_PATH or name.endswith(f"/{INFO_PATH}")]
    return min(roots, key=len) if roots and min(roots, key=len).count("/") <= 1 else None


def check_unpacked_size(members: list[zipfile.ZipInfo], settings: Settings) -> None:
    """Raise TooLargeError if members unpack to more than the limit; zipfile never yields more than they declare."""
    for member in members:
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            method = f"{member.filename}, compressed with method {member.compress_type}"
            raise invalid_data("member", method, "a stored or deflated member")
    total = sum(member.file_size for member in members)
    if total > settings.max_unpacked_bytes:
        raise TooLargeError(f"The archive unpacks to {total} bytes, expected at most {settings.max_unpacked_bytes}")


def add_member(member: str, error: ServiceError) -> ServiceError:
    """Return an error with the name of the archive member in which it occurred."""
    if isinstance(error, TooLargeError) or not error.detail:
        return error
    wrong = error.detail[0]
    message = f"{readable(member[:200])}: {sentence(wrong)}"
    return invalid_data(f"{member}: {wrong.field}", wrong.value, wrong.expected, message)


def numbers_in_name(name: str) -> list[int]:
    """Return the numbers in a name, to sort chunk_0/file_2 before chunk_0/file_10."""
    return [int(number) for number in re.findall(r"[0-9]{1,18}", name)]


@contextmanager
def unpack_bag(path: Path, settings: Settings) -> Iterator[list[Path]]:
    """Unpack a zipped bag; return its files in the order of their recording.

    They have new names in a folder that is removed at the end. Raise InvalidDataError or TooLargeError.
    """
    with TemporaryDirectory(dir=path.parent) as folder:
        with open_zip(path, _COMPLETE) as archive:
            try:
                files = _unpack(archive, Path(folder), settings)
            except ERRORS as error:
                if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
                    raise  # the disk is full: not an error of the archive
                raise unreadable("file", first_line(error), _COMPLETE) from None
        yield files


def _unpack(archive: zipfile.ZipFile, folder: Path, settings: Settings) -> list[Path]:
    files = []
    room = settings.max_unpacked_bytes
    for index, member in enumerate(_bag_members(archive, settings)):
        file = folder / f"{index}.bag"
        packed = member.filename.endswith(".zstd")
        with archive.open(member) as source, file.open("xb") as target:
            stream = decompress(source, "zstd") if packed else source
            while piece := stream.read(COPY_BYTES):
                room -= len(piece)
                if room < 0:
                    raise TooLargeError(f"The archive unpacks to more than {settings.max_unpacked_bytes} bytes")
                target.write(piece)
        files.append(file)
    return files


def decompress(source: IO[bytes], compression: str) -> Any:
    """Return a file of the content of one that is compressed with gzip or zstd."""
    pa = import_extra("pyarrow", "ingest")
    return pa.CompressedInputStream(pa.PythonFile(source, "r"), compression)


def _bag_members(archive: zipfile.ZipFile, settings: Settings) -> list[zipfile.ZipInfo]:
    """Return the files of one bag in order: recorders number the parts of a recording, name_0.db3 to name_10.db3."""
    members = [member for member in archive.infolist() if member.filename.endswith(BAG_ENDINGS)]
    if not members:
        raise invalid_data("file", f"an archive without {', '.join(BAG_ENDINGS)} files", "a complete bag")
    check_unpacked_size(members, settings)
    if len(folders := sorted({str(PurePosixPath(member.filename).parent) for member in members})) > 1:
        raise invalid_data("file", f"an archive with bags in several folders: {', '.join(folders[:5])}", "one bag")
    return sorted(
        members, key=lambda each: (numbers_in_name(PurePosixPath(each.filename).name.split(".")[0])[-1:], each.filename)
    )

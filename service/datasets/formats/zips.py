"""Zip archives from strangers: measured before anything is unpacked, and never unpacked by the names they give."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from service.datasets.formats.blocks import said
from service.foundation.errors import TooLargeError, invalid_data
from service.foundation.settings import Settings

READ_BYTES = 16 * 1024 * 1024
"""Largest single read from the file: no list of members is longer, whatever the archive says."""
ERRORS = (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, RuntimeError, ValueError)
"""What zipfile raises of a damaged archive: RuntimeError of a password, NotImplementedError of other compressions."""


@contextmanager
def open_zip(path: Path, settings: Settings, expected: str) -> Iterator[zipfile.ZipFile]:
    """Open an archive whose members have plain names, each once; raise InvalidDataError of any other."""
    with path.open("rb", buffering=0) as raw:
        try:
            archive = zipfile.ZipFile(_Bounded(raw))
        except ERRORS as error:
            text = said(error)
            raise invalid_data("file", "no zip archive" if "not a zip file" in text else text, expected) from None
        with archive:
            members = archive.infolist()
            if len(members) > settings.max_zip_members:
                raise invalid_data("file", f"{len(members)} members", f"at most {settings.max_zip_members}")
            seen: set[str] = set()
            for member in members:
                name = member.orig_filename
                if not name.isprintable() or "\\" in name or name.startswith("/") or ".." in name.split("/"):
                    raise invalid_data("member", name, "a plain name below the archive's folder")
                if name in seen:
                    raise invalid_data("member", name, "every member once")
                seen.add(name)
            yield archive


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


class _Bounded(io.BufferedReader):
    """A file of which no read takes more than READ_BYTES."""

    def read(self, size: int | None = -1, /) -> bytes:
        """As of any file; raise ValueError where too much is asked for."""
        if size is None or size < 0:  # the end of the file, as far as a comment may reach
            size = READ_BYTES
        if size > READ_BYTES:
            raise ValueError(f"a list of members of {size} bytes")
        return super().read(size)

"""Unpacking of a compressed recording: gzip, zstd, or a zip with one file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Literal, cast

from service.datasets.formats.table import first_line, unreadable
from service.datasets.formats.zips import COPY_BYTES, ERRORS, check_unpacked_size, decompress, open_zip
from service.foundation.errors import TooLargeError
from service.foundation.settings import Settings

Compression = Literal["gzip", "zstd", "zip"]
MAGIC = ((b"\x1f\x8b", "gzip"), (b"\x28\xb5\x2f\xfd", "zstd"))


@contextmanager
def unpacked(path: Path, compression: str, settings: Settings) -> Iterator[Path]:
    """Unpack a file to a temporary one beside it; raise InvalidDataError or TooLargeError."""
    with TemporaryDirectory(dir=path.parent) as folder:
        target = Path(folder) / "recording"
        with ExitStack() as stack, target.open("xb") as out:
            source = _open(path, cast(Compression, compression), settings, stack)
            while piece := _read(source, compression):
                if out.tell() + len(piece) > settings.max_unpacked_bytes:
                    raise TooLargeError(f"The file unpacks to more than {settings.max_unpacked_bytes} bytes")
                out.write(piece)
        yield target


def _open(path: Path, compression: Compression, settings: Settings, stack: ExitStack) -> IO[bytes]:
    if compression == "zip":
        archive = stack.enter_context(open_zip(path, "a zip archive with one file"))
        members = [each for each in archive.infolist() if not each.is_dir()]
        check_unpacked_size(members, settings)
        try:
            return stack.enter_context(archive.open(members[0]))
        except ERRORS as error:
            raise unreadable("file", first_line(error), "a complete zip archive") from None
    return cast(IO[bytes], decompress(stack.enter_context(path.open("rb")), compression))


def _read(source: IO[bytes], compression: str) -> bytes:
    try:
        return source.read(COPY_BYTES)
    except ERRORS as error:
        raise unreadable("file", first_line(error), f"a complete {compression} file") from None

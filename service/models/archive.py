"""The form of an exported version: a tar file of a few plain files, by exact name and of limited size.

It is written and read here and not by `tarfile`: that follows links, sparse files, extended headers and numbers of any
size, of which an archive of a model has none, and which have been the way in for many an attack. Whatever GNU tar and
bsdtar write of plain files with short names is read too.
"""

from __future__ import annotations

import re
import tarfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, NamedTuple

from lipcore.files.manifest import MANIFEST, ROBOT, TENSORS

EXPORT, CHECKSUMS = "export.json", "checksums.json"
MEMBERS = (EXPORT, CHECKSUMS, MANIFEST, TENSORS, ROBOT)
FORMAT, FORMAT_VERSION = "lipserve-archive", 1
MEDIA_TYPE = "application/x-tar"
BLOCK = 512
CHUNK = 1 << 20
_OCTAL = re.compile(rb"[ 0]*([0-7]{1,12})[ \0]*")
_MAGIC = (b"ustar\x0000", b"ustar  \x00")
_KINDS = {
    b"1": "a hard link",
    b"2": "a symbolic link",
    b"3": "a device",
    b"4": "a device",
    b"5": "a folder",
    b"6": "a pipe",
    b"S": "a sparse file",
    b"x": "an extended header",
    b"g": "an extended header",
    b"L": "a long name",
    b"K": "a long name",
}


class ArchiveError(ValueError):
    """The file is no archive that can be taken. member: where that is; given, expected: what is wrong there."""

    def __init__(self, member: str, given: str, expected: str) -> None:
        super().__init__(f"{member} is {given}, expected {expected}")
        self.member, self.given, self.expected = member, given, expected


class Part(NamedTuple):
    """A member to be written: its content, whole or from a file that is read from its beginning."""

    name: str
    size: int
    content: bytes | IO[bytes]


class Member(NamedTuple):
    """Where the content of a member lies in an archive."""

    offset: int
    size: int


def size(parts: list[Part]) -> int:
    """Bytes of the archive that `stream` makes of these parts."""
    return sum(BLOCK + each.size + _padding(each.size) for each in parts) + 2 * BLOCK


def stream(parts: list[Part]) -> Iterator[bytes]:
    """The archive, piece by piece; files are closed at its end, and where it is given up."""
    try:
        for part in parts:
            info = tarfile.TarInfo(part.name)
            info.size = part.size
            yield info.tobuf(tarfile.USTAR_FORMAT)
            if isinstance(part.content, bytes):
                yield part.content
            else:
                part.content.seek(0)
                while piece := part.content.read(CHUNK):
                    yield piece
            yield bytes(_padding(part.size))
        yield bytes(2 * BLOCK)
    finally:
        for part in parts:
            if not isinstance(part.content, bytes):
                part.content.close()


def members(path: Path, limits: Mapping[str, int]) -> dict[str, Member]:
    """Where the members of an archive lie, by name; nothing of them is read. limits: most bytes of each.

    Raise ArchiveError for anything but plain files with these names, each once, complete and within its limit.
    """
    places: dict[str, Member] = {}
    length = path.stat().st_size
    with path.open("rb") as file:
        while True:
            header = file.read(BLOCK)
            if len(header) < BLOCK:
                raise ArchiveError("archive", f"cut off at byte {length}", "a complete tar file")
            if not any(header):
                _check_end(file)
                return places
            name, count = _header(header)
            if name not in limits:
                raise ArchiveError(name, "a file that no model has", f"one of {', '.join(limits)}")
            if name in places:
                raise ArchiveError(name, "there twice", "each file once")
            if count > limits[name]:
                raise ArchiveError(name, f"a file of {count} bytes", f"at most {limits[name]}")
            places[name] = Member(file.tell(), count)
            following = file.tell() + count + _padding(count)
            if following > length:
                raise ArchiveError(name, f"cut off at byte {length - file.tell()}", f"{count} bytes")
            file.seek(following)


def read(path: Path, member: Member) -> bytes:
    """The content of a member."""
    with path.open("rb") as file:
        file.seek(member.offset)
        return file.read(member.size)


def _padding(count: int) -> int:
    return -count % BLOCK


def _check_end(file: IO[bytes]) -> None:
    """After its first block of zeros an archive has at least one more, and nothing else."""
    rest = 0
    while piece := file.read(CHUNK):
        rest += len(piece)
        if any(piece):
            raise ArchiveError("archive", "followed by more data", "nothing after its end")
    if rest < BLOCK:
        raise ArchiveError("archive", "without its end", "a complete tar file")


def _header(header: bytes) -> tuple[str, int]:
    """Name and size of a plain file; raise ArchiveError."""
    checksum = _number(header[148:156])
    # its own field counts as spaces
    if checksum != sum(header[:148]) + 8 * ord(" ") + sum(header[156:]):
        raise ArchiveError("archive", "not a tar file, or damaged: a header does not have its checksum", "a tar file")
    if header[257:265] not in _MAGIC:
        raise ArchiveError("archive", "a tar file of an old form", "the form ustar or that of GNU tar")
    raw, _, after = header[:100].partition(b"\0")
    name = raw.decode("ascii", "backslashreplace")
    if any(after) or any(header[345:500]) or not name.isprintable():
        raise ArchiveError(ascii(name)[1:-1], "a file in a folder or with more to its name", "a plain name")
    kind = header[156:157]
    if kind not in (b"0", b"\0") or any(header[157:257]):
        raise ArchiveError(name, _KINDS.get(kind, f"of the kind {kind!r}"), "a plain file")
    count = _number(header[124:136])
    if count is None:
        raise ArchiveError(name, f"of the size {header[124:136]!r}", "an octal number of bytes")
    return name, count


def _number(field: bytes) -> int | None:
    match = _OCTAL.fullmatch(field)
    return None if match is None else int(match[1], 8)

"""Read the archive of a version, which may come from an untrusted source.

An archive is a tar file of a few plain files with exact names and limited sizes. Of `tarfile` only the functions for a
single header are used. The rest follows links, sparse files, extended headers and numbers of any size. Model archives
contain none of these, and many attacks use them.
"""

from __future__ import annotations

import tarfile
from collections.abc import Mapping
from io import SEEK_CUR
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lipcore.files import persistence, strict_json
from lipcore.files.manifest import MANIFEST, ROBOT, TENSORS, Limits, ModelFormatError
from service.contract.jobs import MAX_OPTIONS
from service.contract.models import ModelName
from service.foundation.errors import InvalidDataError, invalid_data, problem
from service.foundation.settings import Settings

EXPORT, CHECKSUMS = "export.json", "checksums.json"
SIGNATURE = "signature.json"
"""Present in archives that earlier releases signed; ignored."""
FORMAT, FORMAT_VERSION = "lipserve-archive", 1
BLOCK = 512
_KINDS = {
    tarfile.LNKTYPE: "a hard link",
    tarfile.SYMTYPE: "a symbolic link",
    **dict.fromkeys((tarfile.CHRTYPE, tarfile.BLKTYPE), "a device"),
    tarfile.DIRTYPE: "a folder",
    tarfile.FIFOTYPE: "a pipe",
    tarfile.GNUTYPE_SPARSE: "a sparse file",
    **dict.fromkeys((tarfile.XHDTYPE, tarfile.XGLTYPE), "an extended header"),
    **dict.fromkeys((tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK), "a long name"),
}


MAX_JSON_BYTES = 64 * 1024
"""Maximum size of an archive member that describes other members, bytes."""
MAX_MANIFEST_BYTES = 1024 * 1024
MAX_ARCHIVE_BYTES, MAX_URDF_BYTES = 128 * 1024 * 1024, 2 * 1024 * 1024
"""Maximum size of a version's archive, and of a URDF in it or uploaded, bytes."""
MAX_TORQUES = 10_000
"""Maximum torques (samples times joints) that the posterior of an imported version may be conditioned on. Reading needs
memory that grows with the square: 0.8 GB at this limit.
"""


class ArchiveOrigin(BaseModel):
    """Content of `export.json`: the origin of an archive."""

    model_config = ConfigDict(extra="forbid", strict=True)

    format: str = Field(pattern=f"^{FORMAT}$")
    format_version: int = Field(ge=FORMAT_VERSION, le=FORMAT_VERSION)
    model: ModelName
    version: int = Field(ge=1, lt=2**31)
    revision: int = Field(ge=0, lt=2**63)
    learnt: bool
    created_at: str = Field(max_length=40)
    exported_at: str = Field(max_length=40)
    software: dict[str, str | int] = Field(max_length=20)


class ArchiveError(ValueError):
    """The file is not a valid archive.

    `member` is the damaged member, `given` what is wrong there, `expected` what is required.
    """

    def __init__(self, member: str, given: str, expected: str) -> None:
        super().__init__(f"{member} is {given}, expected {expected}")
        self.member, self.given, self.expected = member, given, expected


def members(path: Path, limits: Mapping[str, int]) -> dict[str, bytes]:
    """Return the members of an archive by name; `limits` gives the maximum bytes of each.

    Raise ArchiveError unless all members are plain files with these names, each once, complete and within its limit.
    """
    files: dict[str, bytes] = {}
    length = path.stat().st_size
    with path.open("rb") as file:
        while any(header := file.read(BLOCK)) or len(header) < BLOCK:
            if len(header) < BLOCK:
                raise ArchiveError("archive", f"cut off at byte {length}", "a complete tar file")
            name, count = _header(header)
            if name not in limits:
                raise ArchiveError(name, "an unknown file", f"one of {', '.join(limits)}")
            if name in files:
                raise ArchiveError(name, "given twice", "each file once")
            if count > limits[name]:
                raise ArchiveError(name, f"a file of {count} bytes", f"at most {limits[name]}")
            if file.tell() + count + padding(count) > length:
                raise ArchiveError(name, f"cut off at byte {length - file.tell()}", f"{count} bytes")
            files[name] = file.read(count)
            file.seek(padding(count), SEEK_CUR)
        rest = file.read()
    if any(rest):
        raise ArchiveError("archive", "followed by more data", "nothing after its end")
    if len(rest) < BLOCK:
        raise ArchiveError("archive", "cut off before its end", "a complete tar file")
    return files


def padding(count: int) -> int:
    """Return the number of padding bytes after `count` bytes in a tar file."""
    return -count % BLOCK


def _header(header: bytes) -> tuple[str, int]:
    """Return the name and size of a plain file; raise ArchiveError."""
    try:
        info = tarfile.TarInfo.frombuf(header, "ascii", "backslashreplace")
    except tarfile.HeaderError as error:
        raise ArchiveError("archive", f"not a tar file, or damaged: {error}", "a tar file") from None
    name = ascii(info.name)[1:-1]
    if info.type not in (tarfile.REGTYPE, tarfile.AREGTYPE) or info.linkname:
        raise ArchiveError(name, _KINDS.get(info.type, f"of the kind {info.type!r}"), "a plain file")
    size = header[124:136].strip(b" \0")  # TarInfo also accepts other forms and negative sizes
    if not size.isdigit():
        raise ArchiveError(name, f"of the size {header[124:136]!r}", "an octal number of bytes")
    return name, info.size


def read(upload: Path, settings: Settings) -> tuple[ArchiveOrigin, dict[str, bytes]]:
    """Return the origin of an archive and the files of its model by name, checksums verified.

    Raise InvalidDataError naming the damaged member.
    """
    limits = {
        EXPORT: MAX_JSON_BYTES,
        CHECKSUMS: MAX_JSON_BYTES,
        SIGNATURE: MAX_JSON_BYTES,
        MANIFEST: MAX_MANIFEST_BYTES,
        TENSORS: MAX_ARCHIVE_BYTES,
        ROBOT: MAX_URDF_BYTES,
    }
    try:
        files = members(upload, limits)
    except ArchiveError as error:
        raise invalid_data(error.member, error.given, error.expected) from None
    for name in (EXPORT, CHECKSUMS, MANIFEST, TENSORS, ROBOT, SIGNATURE):
        if name not in files and name not in (ROBOT, SIGNATURE):
            raise invalid_data(name, "missing", "a file of that name in the archive")
    files.pop(SIGNATURE, None)
    sums = _json(CHECKSUMS, files.pop(CHECKSUMS))
    if not isinstance(sums, dict) or sums.keys() != files.keys():
        given = f"for {', '.join(map(strict_json.quote, sums))}" if isinstance(sums, dict) else strict_json.quote(sums)
        raise invalid_data(CHECKSUMS, given, f"the sha256 of each of {', '.join(files)}")
    for name, content in files.items():
        if persistence.sha256(content) != sums[name]:
            raise invalid_data(name, "different from its sha256 in checksums.json", "an undamaged file")
    try:
        return ArchiveOrigin.model_validate(_json(EXPORT, files.pop(EXPORT))), files
    except ValidationError as error:
        raise invalid_member(EXPORT, error) from None


def limits_of(settings: Settings) -> Limits:
    """Return the size limits of an imported model."""
    return Limits(
        joints=settings.max_joints,
        inducing_samples=MAX_OPTIONS["posterior_samples"],
        inducing_torques=MAX_TORQUES,
        inducing_outputs=MAX_OPTIONS["max_inducing_outputs"],
        manifest_bytes=MAX_MANIFEST_BYTES,
        robot_bytes=MAX_URDF_BYTES,
    )


def try_out(upload: Path, settings: Settings) -> None:
    """Read an archive and parse its model, store nothing; raise InvalidDataError.

    For a caged process: the caller reads the archive again once this has succeeded.
    """
    _, files = read(upload, settings)
    try:
        persistence.parse(files, limits_of(settings))
    except ModelFormatError as error:
        raise invalid_model(error) from None


def invalid_model(error: ModelFormatError) -> InvalidDataError:
    """Return the error for files that are not a valid model."""
    return InvalidDataError(f"{error.file}: {error}", [problem(error.file, str(error), "a valid model")])


def _json(member: str, content: bytes) -> Any:
    try:
        value = strict_json.read(content, MAX_JSON_BYTES)
        strict_json.check_texts("", value)
    except strict_json.StrictJsonError as error:
        item = problem(member, str(error), "JSON as an export writes it")
        raise InvalidDataError(f"{member}: {error}", [item]) from None
    return value


def invalid_member(member: str, error: ValidationError) -> InvalidDataError:
    """Return the error for invalid content of a member."""
    first = error.errors()[0]
    where = ".".join([member, *map(str, first["loc"])])
    return invalid_data(where, first.get("input"), first["msg"].removeprefix("Input should be "))

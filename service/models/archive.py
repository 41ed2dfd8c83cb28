"""Export a version: as an archive with checksums and origin, or in a format of `lipcore.export.formats`.

Archives are read by `archive_reading`.
"""

from __future__ import annotations

import json
import tarfile
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from lipcore.export.formats import FORMATS
from lipcore.export.origin import ModelOrigin
from lipcore.files import persistence
from lipcore.files.manifest import MANIFEST, TENSORS, ModelFormatError
from lipcore.vocabulary import ExportFormat
from service.foundation.errors import InvalidRequestError, UnreadableVersionError, invalid_request, problem
from service.models import registry
from service.models.archive_reading import BLOCK, CHECKSUMS, EXPORT, FORMAT, FORMAT_VERSION, padding
from service.models.exports import note_export
from service.models.lineage import software
from service.models.loaded import LoadedModels
from service.models.tracing import write_in_process
from service.storage.database import VersionRow, now

MEDIA_TYPE = "application/x-tar"


@dataclass(frozen=True)
class ExportedFile:
    """A file that is ready to be sent.

    `name` is the file name, `size` the length in bytes, `pieces` the content.
    """

    name: str
    media_type: str
    size: int
    pieces: Iterator[bytes]


def export(
    loaded: LoadedModels,
    model: str,
    version: int | None,
    alias: str | None,
    learnt: bool,
    kind: ExportFormat = "archive",
) -> ExportedFile:
    """Export a version, or the serving version if none is named. Blocking: use it in a thread.

    If `learnt`, include what the version has learnt online; else export it as trained. A format of several files
    becomes a tar. Everything is checked before the first byte is sent. Raise NotFoundError, InvalidRequestError for
    both a version and an alias or for an estimator that the format cannot express, UnreadableVersionError for damaged
    files, StorageFullError.
    """
    row = _find(loaded, model, version, alias)
    try:
        files, revision = _files(loaded, row, learnt)
        origin = ModelOrigin(row.model, row.version, revision, persistence.sha256(files[TENSORS]))
        if kind != "archive":
            manifest = json.loads(files[MANIFEST]) if revision else row.manifest
            made = _export_as(kind, loaded, files, manifest["parameters"], origin)
            note_export(loaded.database, origin, kind)
            return made
    except ModelFormatError as error:
        registry.find(loaded.database, row.model, row.version)  # raises if the version was deleted meanwhile
        message = f"version {row.version} of model {row.model!r} cannot be exported: {error}"
        raise UnreadableVersionError(message) from error
    about = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "model": row.model,
        "version": row.version,
        "revision": revision,
        "learnt": revision > 0,
        "created_at": row.created_at,
        "exported_at": now(),
        "software": software(),
    }
    files = {EXPORT: _json(about), **files}
    sums = _json({name: persistence.sha256(content) for name, content in files.items()})
    file = _packed(loaded, {CHECKSUMS: sums, **files})
    note_export(loaded.database, origin, kind)
    return ExportedFile(f"{origin.stem}.tar", MEDIA_TYPE, file.tell(), _pieces(file))


def _export_as(
    kind: ExportFormat,
    loaded: LoadedModels,
    files: Mapping[str, bytes],
    parameters: Mapping[str, Any],
    origin: ModelOrigin,
) -> ExportedFile:
    """Return a model in one of FORMATS; raise InvalidRequestError if the format cannot express it."""
    form = FORMATS[kind]
    try:
        if form.is_traced:
            written = write_in_process(kind, files, parameters, origin)
        else:
            written = form.write(persistence.decode(files), parameters, origin)
    except ModelFormatError:
        raise
    except ValueError as error:
        item = problem("version", origin.version, f"a version of estimator {', '.join(form.estimators)}")
        message = f"version {origin.version} of model {origin.model!r} cannot be written as {kind}: {error}"
        raise InvalidRequestError(message, [item]) from error
    if form.media_type is not None:
        ((name, content),) = written.items()
        return ExportedFile(name, form.media_type, len(content), iter((content,)))
    file = _packed(loaded, written)
    return ExportedFile(f"{origin.stem}-{kind}.tar", MEDIA_TYPE, file.tell(), _pieces(file))


def _find(loaded: LoadedModels, model: str, version: int | None, alias: str | None) -> VersionRow:
    """Return a version by number or alias, the serving version if both are None.

    Raise NotFoundError, or InvalidRequestError if both are given.
    """
    if version is not None and alias is not None:
        message = "Expected `version` or `alias`, got both."
        raise invalid_request("version or alias", "both", "at most one of the two", message)
    return registry.find(loaded.database, model, loaded.resolve_version(model, version, alias)[0])


def _files(loaded: LoadedModels, row: VersionRow, learnt: bool) -> tuple[dict[str, bytes], int]:
    """Return the checked files of a version by name, and their revision: 0 as trained."""
    files = loaded.files.read_version(row.folder, lambda folder: _checked(folder, row))
    if not learnt:
        return files, 0
    served = loaded.hot(row.model, row.version)
    base = persistence.decode(files) if served is None else served.base
    known = loaded.learnt.consolidated(row.model, row.version, base)
    if known is None:
        return files, 0
    # a version imported with online updates keeps the record of its earlier ones
    before = {} if (earlier := row.manifest["lineage"].get("learnt")) is None else {"before": earlier}
    learnt_since = {"model": row.model, "version": row.version, "revision": known.revision, **before}
    _, files = persistence.encode(known.model, {**row.manifest["lineage"], "learnt": learnt_since})
    return {MANIFEST: files.pop(MANIFEST), **files}, known.revision


def _checked(folder: Path, row: VersionRow) -> dict[str, bytes]:
    files = persistence.read_files(folder)
    if row.checksums is not None:
        persistence.check_checksums(files, row.checksums)
    return files


def _packed(loaded: LoadedModels, files: Mapping[str, bytes]) -> IO[bytes]:
    """Write the archive to an unnamed file on disk, as the client may read slowly."""
    loaded.storage.disk.require(sum(map(len, files.values())))
    file = tempfile.TemporaryFile(dir=loaded.files.uploads)  # noqa: SIM115 - `_pieces` closes it
    try:
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            file.write(info.tobuf(tarfile.USTAR_FORMAT) + content + bytes(padding(info.size)))
        file.write(bytes(2 * BLOCK))
    except BaseException:
        file.close()
        raise
    return file


def _pieces(file: IO[bytes]) -> Iterator[bytes]:
    """Yield the content of a file; close the file at its end, or if the reader stops early."""
    with file:
        file.seek(0)
        while piece := file.read(1 << 20):
            yield piece


def _json(value: Any) -> bytes:
    return json.dumps(value, indent=2, allow_nan=False).encode() + b"\n"

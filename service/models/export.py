"""A version for use elsewhere: an archive with its files, their checksums and what made them, or its arm as a URDF."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lipcore.files import persistence
from lipcore.files.manifest import MANIFEST, TENSORS, ModelFormatError
from lipcore.files.urdf_writer import urdf_of_parameters
from service.foundation.errors import InvalidRequestError, UnreadableVersionError, invalid_request, not_found, problem
from service.models import archive, registry
from service.models.archive import CHECKSUMS, EXPORT, Part
from service.models.lineage import software
from service.models.loaded import LoadedModels
from service.models.moves import SERVING
from service.storage.database import VersionRow, now


@dataclass(frozen=True)
class Exported:
    """An archive that is ready to be sent. size: bytes; name: of the file."""

    name: str
    size: int
    pieces: Iterator[bytes]


def export(loaded: LoadedModels, model: str, version: int | None, alias: str | None, learnt: bool) -> Exported:
    """Archive a version, the one that serves where none is named. Not for the event loop.

    learnt: with what it has learnt online, else as trained. Nothing is sent before all of it has been checked. Raise
    NotFoundError, InvalidRequestError for both a version and an alias, UnreadableVersionError for damaged files,
    StorageFullError.
    """
    row = find(loaded, model, version, alias)
    try:
        files, revision = _files(loaded, row, learnt)
    except ModelFormatError as error:
        registry.find(loaded.database, row.model, row.version)  # it may have been deleted meanwhile
        message = f"version {row.version} of model {row.model!r} cannot be exported: {error}"
        raise UnreadableVersionError(message) from error
    about = {
        "format": archive.FORMAT,
        "format_version": archive.FORMAT_VERSION,
        "model": row.model,
        "version": row.version,
        "revision": revision,
        "learnt": revision > 0,
        "created_at": row.created_at,
        "exported_at": now(),
        "software": software(),
    }
    files = {EXPORT: _json(about), **files}
    sums = {name: persistence.sha256(content) for name, content in files.items()}
    parts = [Part(name, len(content), content) for name, content in {CHECKSUMS: _json(sums), **files}.items()]
    size = archive.size(parts)
    kept = [_on_disk(loaded, each) if each.name == TENSORS else each for each in parts]
    suffix = f"-r{revision}" if revision else ""
    return Exported(f"{row.model}-v{row.version}{suffix}.tar", size, archive.stream(kept))


def find(loaded: LoadedModels, model: str, version: int | None, alias: str | None) -> VersionRow:
    """Return the version of a number or of an alias, the one that serves where both are None.

    Raise NotFoundError, InvalidRequestError for both.
    """
    if version is not None and alias is not None:
        raise invalid_request("version or alias", "both", "one of the two at most")
    if alias is not None:
        version = loaded.newest(model, alias)
        if version is None and alias != SERVING:
            registry.find(loaded.database, model, None)  # that there is no such model is said first
            raise not_found("alias", alias)
    return registry.find(loaded.database, model, version)


def _files(loaded: LoadedModels, row: VersionRow, learnt: bool) -> tuple[dict[str, bytes], int]:
    """The files of a version by name, checked, and the revision that they are of: 0 as trained."""
    files = loaded.files.read_version(row.folder, lambda folder: _checked(folder, row))
    if not learnt:
        return files, 0
    served = loaded.hot(row.model, row.version)
    base = persistence.decode(files) if served is None else served.base
    known = loaded.learnt.consolidated(row.model, row.version, base)
    if known is None:
        return files, 0
    lineage = {**row.manifest["lineage"], "learnt": _learnt(row, known.revision)}
    _, files = persistence.encode(known.model, lineage)
    return {MANIFEST: files.pop(MANIFEST), **files}, known.revision


def _checked(folder: Path, row: VersionRow) -> dict[str, bytes]:
    files = persistence.read_files(folder)
    if row.checksums is not None:
        persistence.check(files, row.checksums)
    return files


def _learnt(row: VersionRow, revision: int) -> dict[str, Any]:
    """What the lineage says of online updates: of an earlier life too, where the version was imported with some."""
    about: dict[str, Any] = {"model": row.model, "version": row.version, "revision": revision}
    earlier = row.manifest["lineage"].get("learnt")
    return about if earlier is None else {**about, "before": earlier}


def _on_disk(loaded: LoadedModels, part: Part) -> Part:
    """A part whose content waits on disk, in a file without a name, for a client that may be slow."""
    assert isinstance(part.content, bytes)
    loaded.storage.disk.require(part.size)
    file = tempfile.TemporaryFile(dir=loaded.files.uploads)  # noqa: SIM115 - closed by who reads it
    try:
        file.write(part.content)
        file.flush()
    except BaseException:
        file.close()
        raise
    return Part(part.name, part.size, file)


def _json(value: Any) -> bytes:
    return json.dumps(value, indent=2, allow_nan=False).encode() + b"\n"


URDF_MEDIA_TYPE = "application/xml"
URDF_EXAMPLE = """<?xml version="1.0"?>
<robot name="arm-v2" xmlns:drake="http://drake.mit.edu">
  <link name="base" />
  <joint name="joint1" type="revolute">
    <origin xyz="0.0 0.0 0.333" rpy="0.0 0.0 0.0" />
    <parent link="base" />
    <child link="joint1_link" />
    <axis xyz="0.0 0.0 1.0" />
    <limit lower="-2.1" upper="2.3" velocity="1.4" effort="1900.0" />
    <dynamics damping="0.12" friction="0.41" />
  </joint>
  <link name="joint1_link">
    <inertial>
      <origin xyz="0.0 -0.02 -0.05" rpy="0.0 0.0 0.0" />
      <mass value="2.9" />
      <inertia ixx="0.02" ixy="0.0" ixz="0.0" iyy="0.02" iyz="0.0" izz="0.01" />
    </inertial>
  </link>
</robot>
"""


def write_urdf(loaded: LoadedModels, model: str, version: int | None, alias: str | None) -> tuple[str, str]:
    """The name of a file and the URDF that belongs in it, of the version that serves where none is named.

    Raise NotFoundError, InvalidRequestError for both a version and an alias, and for a version without an arm.
    """
    row = find(loaded, model, version, alias)
    name, manifest = f"{row.model}-v{row.version}", row.manifest
    try:
        text = urdf_of_parameters(
            manifest.get("parameters", {}), manifest["joint_names"], manifest["training_range"], name
        )
    except ValueError as error:
        item = problem("version", row.version, "a version with rigid bodies that holds where its joints lie")
        message = f"version {row.version} of model {row.model!r} cannot be written as a URDF: {error}"
        raise InvalidRequestError(message, [item]) from error
    return f"{name}.urdf", text

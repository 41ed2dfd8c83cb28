"""The model that a motion is planned for: saved in a folder, or served under a name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import lipcore
from lipcore import TorqueModel
from lipcore.files import persistence
from lipcore.files.manifest import DEFAULT_LIMITS, MANIFEST, ROBOT, TENSORS, ModelFormatError
from service.client import Client
from service.models import archive

MAX_TENSOR_BYTES = 1 << 30
SMALL = 64 * 1024
LIMITS: Mapping[str, int] = {
    archive.EXPORT: SMALL,
    archive.CHECKSUMS: SMALL,
    MANIFEST: DEFAULT_LIMITS.manifest_bytes,
    TENSORS: MAX_TENSOR_BYTES,
    ROBOT: DEFAULT_LIMITS.robot_bytes,
}


def model(given: str, url: str, version: int | None = None, alias: str | None = None) -> TorqueModel:
    """The model in a folder of that path, or of that name from the service at `url`.

    Raise ModelFormatError for what is no model, ApiError or ServiceUnreachableError where the service has none.
    """
    folder = Path(given)
    if (folder / MANIFEST).is_file():
        return lipcore.load(folder)
    if folder.is_dir():
        raise ModelFormatError(f"{given} holds no {MANIFEST}, expected the folder of a saved model", MANIFEST)
    return fetch(given, url, version, alias)


def fetch(name: str, url: str, version: int | None = None, alias: str | None = None) -> TorqueModel:
    """A served model as it is now, with all that it has learnt online."""
    with TemporaryDirectory(prefix="lipserve-excite-") as folder, Client(url) as client:
        path = client.export(name, Path(folder) / "model.tar", version, alias)
        try:
            found = archive.members(path, LIMITS)
        except archive.ArchiveError as error:
            raise ModelFormatError(str(error), error.member) from None
        files = {each: archive.read(path, member) for each, member in found.items()}
        for each in (archive.EXPORT, archive.CHECKSUMS):
            files.pop(each, None)
        return persistence.decode(files)

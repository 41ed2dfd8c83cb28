"""A version from an archive, which may come from a stranger: everything is checked before anything is kept of it."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lipcore.files import persistence, strict_json
from lipcore.files.manifest import MANIFEST, ROBOT, TENSORS, Limits, ModelFormatError, read_manifest_bytes
from lipcore.files.probing import probe
from lipcore.model.parameters import report
from lipcore.model.warnings import warnings
from service.foundation.errors import InvalidDataError, invalid_data, problem
from service.foundation.settings import Settings
from service.models import archive, registry, signing
from service.models.archive import CHECKSUMS, EXPORT, ArchiveError
from service.models.archive_fields import FIELDS
from service.models.loaded import LoadedModels
from service.models.schema import ModelName, Version
from service.models.signing import SIGNATURE, Signature
from service.storage.database import LearnerRow, ServingRow, now
from service.storage.files import new_id
from service.web.storage_errors import undecided

logger = logging.getLogger(__name__)

SMALL = 64 * 1024
"""Most bytes of the members that only describe the others."""
MANIFEST_BYTES = 1024 * 1024
OPTION_LIMITS = {
    "hyperparameter_samples": "max_hyperparameter_samples",
    "posterior_samples": "max_posterior_samples",
    "max_inducing_outputs": "max_inducing_outputs",
}
"""Options of a fit, and the settings that limit them: a refresh trains with those of the version."""


class About(BaseModel):
    """What `export.json` says: where an archive comes from."""

    model_config = ConfigDict(extra="forbid", strict=True)

    format: str = Field(pattern=f"^{archive.FORMAT}$")
    format_version: int = Field(ge=archive.FORMAT_VERSION, le=archive.FORMAT_VERSION)
    model: ModelName
    version: int = Field(ge=1, lt=2**31)
    revision: int = Field(ge=0, lt=2**63)
    learnt: bool
    created_at: str = Field(max_length=40)
    exported_at: str = Field(max_length=40)
    software: dict[str, str | int] = Field(max_length=20)


def add(loaded: LoadedModels, upload: Path, name: str | None) -> Version:
    """Make a new version of what an archive holds; return it. Not for the event loop.

    name: of the model, that of the archive by default. The version answers only where it is the model's first one: any
    other has to be chosen. Raise InvalidDataError naming the member that is wrong and what is wrong with it.
    """
    settings = loaded.storage.settings
    files, signer = _read(upload, settings)
    try:
        about = About.model_validate(_json(EXPORT, files.pop(EXPORT)))
    except ValidationError as error:
        raise _invalid(EXPORT, error) from None
    manifest = _checked(files, settings)
    model = name or about.model
    signed = {} if signer is None else {"signed_by": signer}
    manifest["lineage"] = {
        **manifest["lineage"],
        "imported": [*manifest["lineage"].get("imported", []), {**about.model_dump(), "imported_at": now(), **signed}],
    }
    files[MANIFEST] = persistence.manifest_bytes(manifest)
    loaded.storage.disk.require(sum(map(len, files.values())))
    folder = new_id("mv")
    with loaded.files.new_version(folder) as target:
        persistence.write(target, files)
    try:
        version, serves = _publish(loaded, model, folder, manifest)
    except BaseException as error:
        if not undecided(error):
            with suppress(OSError):  # what cannot be deleted now is swept
                loaded.files.delete_version(folder)
        raise
    if serves:
        loaded.adopt(model)
    logger.info("imported version %d of model %s: version %d of %s", version, model, about.version, about.model)
    return registry.show_version(loaded.database, model, version)


def _publish(loaded: LoadedModels, model: str, folder: str, manifest: dict[str, Any]) -> tuple[int, bool]:
    """Add the version; return its number, and whether it answers where none is named."""
    with loaded.database.transaction() as session:
        version = registry.publish(session, model, folder, manifest, None, candidate=True)
        serving = session.get(ServingRow, model)
        serves = serving is not None and serving.version == version
        if not serves:  # it is nobody's rival: who imports it says what becomes of it
            session.get_one(LearnerRow, (model, version)).role = "dismissed"
    return version, serves


def _read(upload: Path, settings: Settings) -> tuple[dict[str, bytes], str | None]:
    """The members of an archive, all but the checksums, which they have, and who has signed these, None: nobody."""
    limits = {
        EXPORT: SMALL,
        CHECKSUMS: SMALL,
        SIGNATURE: SMALL,
        MANIFEST: MANIFEST_BYTES,
        TENSORS: settings.max_archive_bytes,
        ROBOT: settings.max_urdf_bytes,
    }
    try:
        files = archive.read(upload, limits)
    except ArchiveError as error:
        raise invalid_data(error.member, error.given, error.expected) from None
    for name in archive.MEMBERS:
        if name not in files and name not in archive.OPTIONAL:
            raise invalid_data(name, "missing", "a file of that name in the archive")
    try:
        signature = Signature.model_validate(_json(SIGNATURE, files.pop(SIGNATURE))) if SIGNATURE in files else None
    except ValidationError as error:
        raise _invalid(SIGNATURE, error) from None
    checksums = files.pop(CHECKSUMS)
    signer = signing.verify(settings, signature, checksums)
    sums = _json(CHECKSUMS, checksums)
    if not isinstance(sums, dict) or sums.keys() != files.keys():
        given = f"of {', '.join(map(strict_json.quote, sums))}" if isinstance(sums, dict) else strict_json.quote(sums)
        raise invalid_data(CHECKSUMS, given, f"the sha256 of each of {', '.join(files)}")
    for name, content in files.items():
        if persistence.sha256(content) != sums[name]:
            raise invalid_data(name, "not what its sha256 in checksums.json says", "an undamaged file")
    return files, signer


def _checked(files: Mapping[str, bytes], settings: Settings) -> dict[str, Any]:
    """The manifest of files that make a model which answers; what can be computed of it is computed anew."""
    limits = Limits(
        joints=settings.max_joints,
        inducing_samples=settings.max_posterior_samples,
        inducing_torques=settings.max_archive_torques,
        inducing_outputs=settings.max_inducing_outputs,
        manifest_bytes=MANIFEST_BYTES,
        robot_bytes=settings.max_urdf_bytes,
    )
    where = ""
    try:
        manifest = read_manifest_bytes(files[MANIFEST], limits)
        if ROBOT in files and "robot" not in manifest:
            raise ModelFormatError(f"{ROBOT} is there, but the manifest names no robot", ROBOT)
        _check_texts(manifest)
        _check_options(manifest["options"], settings)
        for entry, fields in FIELDS.items():
            if entry in manifest:
                where = entry
                fields.model_validate(manifest[entry])
        model = persistence.decode(files, limits)
        probe(model)
        basis = model.posterior.basis
        sizes = {"inducing_outputs": len(basis.outputs), "inducing_samples": len(basis.inducing), "weights": len(basis)}
        manifest["compact"] = {**manifest["compact"], **sizes}
        manifest["parameters"] = report(model.posterior, model.estimator, model.joint_names)
        manifest["warnings"] = warnings(model, manifest["parameters"])
        manifest["hyperparameters"] = {name: value.tolist() for name, value in model.posterior.params.items()}
        read_manifest_bytes(persistence.manifest_bytes(manifest), limits)
    except ModelFormatError as error:
        raise InvalidDataError(f"{error.file}: {error}", [problem(error.file, str(error), "a valid model")]) from None
    except ValidationError as error:
        raise _invalid(f"{MANIFEST}: {where}", error) from None
    except (ValueError, ArithmeticError) as error:  # parameters that no fit has
        raise invalid_data(TENSORS, str(error), "parameters that are finite numbers") from None
    return manifest


def _check_texts(value: Any) -> None:
    """Raise ModelFormatError for a text that a terminal or a log would not show as it is. The depth is limited."""
    if isinstance(value, str):
        if not all(each.isprintable() or each == "\N{NO-BREAK SPACE}" for each in value):
            raise ModelFormatError(f"{strict_json.quote(value)} has a character that cannot be printed")
    elif isinstance(value, dict):
        for name, each in value.items():
            _check_texts(name)
            _check_texts(each)
    elif isinstance(value, list):
        for each in value:
            _check_texts(each)


def _check_options(options: Mapping[str, Any], settings: Settings) -> None:
    for name, setting in OPTION_LIMITS.items():
        most = getattr(settings, setting)
        if options.get(name, 0) > most:
            raise ModelFormatError(f"options.{name} is {options[name]}, expected at most {most}")


def _json(member: str, content: bytes) -> Any:
    try:
        value = strict_json.read(content, SMALL)
        _check_texts(value)
    except (strict_json.StrictJsonError, ModelFormatError) as error:
        raise invalid_data(member, str(error), "JSON as an export writes it") from None
    return value


def _invalid(member: str, error: ValidationError) -> InvalidDataError:
    first = error.errors()[0]
    where = ".".join([member, *map(str, first["loc"])])
    return invalid_data(where, first.get("input"), first["msg"].removeprefix("Input should be "))

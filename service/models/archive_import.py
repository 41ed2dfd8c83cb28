"""Import a version from an archive of unknown origin: everything is checked before anything is stored."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from lipcore.estimators.base import RobotKind
from lipcore.files import persistence
from lipcore.files.manifest import MANIFEST, ROBOT, TENSORS, ModelFormatError, read_manifest_bytes
from lipcore.files.probing import probe
from lipcore.files.strict_json import StrictJsonError, check_texts
from lipcore.model.parameters import report
from lipcore.model.warnings import warnings
from service.contract.jobs import MAX_OPTIONS
from service.contract.models import Promotion, Version
from service.contract.states import PromotionOption
from service.foundation.errors import invalid_data
from service.foundation.settings import Settings
from service.models import archive_reading, registry, texts, verdicts
from service.models.archive_lineage import Lineage
from service.models.archive_reading import invalid_member, invalid_model, limits_of
from service.models.loaded import LoadedModels
from service.runtime import cage
from service.storage.database import now
from service.storage.errors import is_undecided
from service.storage.files import new_id

logger = logging.getLogger(__name__)


def add(loaded: LoadedModels, upload: Path, name: str | None, promotion: PromotionOption | None = None) -> Version:
    """Import an archive as a new version and return it. Blocking: use it in a thread.

    `name` is the model's name; the default is the name in the archive. `promotion` decides whether the version serves;
    the default is the setting. With the option `ask`, the version serves only if it is the model's first and passes the
    acceptance rules by the figures in its lineage. Raise InvalidDataError naming the damaged member, ConflictError for
    a model of another robot.
    """
    settings = loaded.storage.settings
    cage.run("service.models.archive_reading:try_out", type(None), upload, settings, settings=settings, field="archive")
    about, files = archive_reading.read(upload, settings)
    manifest = _checked(files, settings)
    model = name or about.model
    manifest["lineage"] = {
        **manifest["lineage"],
        "imported": [*manifest["lineage"].get("imported", []), {**about.model_dump(), "imported_at": now()}],
    }
    files[MANIFEST] = persistence.manifest_bytes(manifest)
    loaded.storage.disk.require(sum(map(len, files.values())))
    folder = new_id("mv")
    with loaded.files.new_version(folder) as target:
        persistence.write_folder(target, files)
    try:
        version, serves = _publish(loaded, model, folder, manifest, promotion or settings.promotion)
    except BaseException as error:
        if not is_undecided(error):
            with suppress(OSError):  # the sweep deletes what remains
                loaded.files.delete_version(folder)
        raise
    if serves:
        loaded.adopt(model)
    logger.info("imported version %d of model %s: version %d of %s", version, model, about.version, about.model)
    return registry.show_version(loaded.database, model, version)


def _publish(
    loaded: LoadedModels, model: str, folder: str, manifest: dict[str, Any], option: PromotionOption
) -> tuple[int, bool]:
    """Add the version; return its number and whether it serves."""
    with loaded.database.transaction() as session:
        registry.check_robot(session, model, RobotKind.of_manifest(manifest))
        serves, reason = False, "It was imported into a model with other versions. Compare them on a recording first."
        if not registry.has_model(session, model):
            verdict = verdicts.of_version(manifest)
            serves, reason = verdict.serves, texts.describe_verdict(verdict.label, verdict.reason)
        judged = Promotion.of(serves, reason, registry.serving_version(session, model), option)
        version = registry.publish(
            session, model, folder, manifest, None, candidate=not judged.answers, promotion=judged
        )
    return version, judged.answers


def _checked(files: Mapping[str, bytes], settings: Settings) -> dict[str, Any]:
    """Return the manifest of a model that passes all checks, with every computable entry computed again."""
    limits = limits_of(settings)
    try:
        manifest = read_manifest_bytes(files[MANIFEST], limits)
        if ROBOT in files and "robot" not in manifest:
            raise ModelFormatError(f"the archive has {ROBOT}, but the manifest names no robot", ROBOT)
        check_texts("", manifest)
        _check_options(manifest["options"])
        Lineage.model_validate(manifest["lineage"])
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
        raise invalid_model(error) from None
    except StrictJsonError as error:
        raise invalid_model(ModelFormatError(str(error))) from None
    except ValidationError as error:
        raise invalid_member(f"{MANIFEST}: lineage", error) from None
    except (ValueError, ArithmeticError) as error:  # parameters that no fit can produce
        raise invalid_data(TENSORS, str(error), "parameters that are finite numbers") from None
    return manifest


def _check_options(options: Mapping[str, Any]) -> None:
    for name, most in MAX_OPTIONS.items():
        if options.get(name, 0) > most:
            raise ModelFormatError(f"options.{name} is {options[name]}, expected at most {most}")

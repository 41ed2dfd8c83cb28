"""Models and versions as the protocol names and describes them."""

from __future__ import annotations

import re

from anyio import CapacityLimiter, to_thread

from lipcore.model.torque_model import TorqueModel
from service.foundation.errors import NotFoundError, NotReadyError, UnreadableVersionError, problem, sentence
from service.models import registry
from service.models.loaded import LoadedModels, Served
from service.models.schema import ALIAS
from service.oip.outputs import FORWARD, shapes
from service.oip.schema import INPUTS, TORQUE, ModelMetadata, TensorMetadata

_LISTED = 20


async def find(loaded: LoadedModels, turns: CapacityLimiter, name: str, version: str | None) -> Served:
    """Return a version by its number or an alias, the one that serves where None, loaded if need be.

    turns: of what loads. Raise NotFoundError naming those there are.
    """
    number, alias = (None, None) if version is None else _meant(version)
    found = loaded.hot(name, number, alias)
    if found is not None:
        return found
    return await to_thread.run_sync(_load, loaded, name, version, number, alias, limiter=turns)


async def ready(loaded: LoadedModels, turns: CapacityLimiter, name: str, version: str | None) -> Served:
    """Like `find`, but raise NotReadyError where the version cannot be loaded."""
    try:
        return await find(loaded, turns, name, version)
    except UnreadableVersionError as error:
        raise NotReadyError(error.message) from error


def metadata(loaded: LoadedModels, served: Served) -> ModelMetadata:
    """Describe a version and name all of its model; raise NotFoundError. Not for the event loop."""
    model = served.model
    inputs = [TensorMetadata(name=each, shape=[-1, model.n_joints]) for each in INPUTS]
    outputs = shapes(model)
    if FORWARD in outputs:
        inputs.append(TensorMetadata(name=TORQUE, shape=[-1, model.n_joints], parameters={"optional": True}))
    return ModelMetadata(
        name=served.name,
        versions=_known(loaded, served.name),
        platform=f"lipserve_{model.estimator.name}",
        inputs=inputs,
        outputs=[TensorMetadata(name=each, shape=list(shape)) for each, shape in outputs.items()],
        parameters=_parameters(served, model),
    )


def _parameters(served: Served, model: TorqueModel) -> dict[str, str | int]:
    return {
        "version": str(served.version),
        "revision": served.revision,
        "torque_convention": model.torque_convention,
        "joint_names": ",".join(model.joint_names),
    }


def _meant(version: str) -> tuple[int | None, str | None]:
    """A version's number or an alias; the number 0, which no version has, for what is neither."""
    if re.fullmatch(ALIAS, version):
        return None, version
    number = int(version) if version.isascii() and version.isdigit() and len(version) < 10 else 0
    return number if str(number) == version else 0, None


def _load(loaded: LoadedModels, name: str, version: str | None, number: int | None, alias: str | None) -> Served:
    try:
        return loaded.get(name, number, alias)
    except NotFoundError as error:
        if error.detail[0].field == "model":
            raise NotFoundError(f"no model {name[:200]!r}: GET /v1/models lists all", error.detail) from error
        item = problem("version", version, f"one of {', '.join(_names(loaded, name)[-_LISTED:])}")
        raise NotFoundError(f"{sentence(item)}, of model {name!r}", [item]) from error


def _names(loaded: LoadedModels, name: str) -> list[str]:
    """Aliases and numbers."""
    return [*registry.show(loaded.database, name).aliases, *_known(loaded, name)]


def _known(loaded: LoadedModels, name: str) -> list[str]:
    return [str(each.version) for each in registry.show(loaded.database, name).versions]

"""What HTTP and gRPC answer alike: models and versions as the protocol names and describes them, and inference."""

from __future__ import annotations

import re
from collections.abc import Callable

from anyio import CapacityLimiter

from lipcore.model.torque_model import TorqueModel
from service.api.limits.requests import in_turn
from service.api.oip import query, schema
from service.api.oip.query import shapes
from service.api.oip.tensors import Message
from service.api.route import Reply
from service.contract.models import ALIAS
from service.foundation.errors import NotFoundError, NotReadyError, UnreadableVersionError, problem, sentence
from service.models import registry
from service.models.loaded import LoadedModels, ServedModel

SMALL = 16 * 1024
"""Bytes of a body that is decoded on the event loop: one query of the largest robot fits many times."""
_LISTED = 20


async def find(loaded: LoadedModels, turns: CapacityLimiter, name: str, version: str | None) -> ServedModel:
    """Return a version by its number or an alias, the one that serves where None, loaded if need be. turns: of what
    loads. Raise NotFoundError naming those there are."""
    number, alias = (None, None) if version is None else _meant(version)
    served = loaded.hot(name, number, alias)
    if served is not None:
        return served
    return await in_turn(turns, _load, loaded, name, version, number, alias)


async def ready(loaded: LoadedModels, turns: CapacityLimiter, name: str, version: str | None) -> ServedModel:
    """Return a version once it is in memory; raise NotFoundError, or NotReadyError where it cannot be read."""
    try:
        return await find(loaded, turns, name, version)
    except UnreadableVersionError as error:
        raise NotReadyError(error.message) from error


async def infer(
    loaded: LoadedModels,
    turns: CapacityLimiter,
    name: str,
    version: str | None,
    size: int,
    decode: Callable[[], Message],
) -> Reply:
    """Answer any request, a wrong one with the error that it raises: one query here, all else in a thread.

    size: bytes of the body, which `decode` makes a message of.
    """
    settings = loaded.storage.settings
    served = await find(loaded, turns, name, version)
    if size > SMALL:
        return await in_turn(turns, query.infer, served, decode, settings)
    message = decode()
    question = query.read_question(served, message, settings)
    if question.quick:
        return query.respond(served, message, question)
    return await in_turn(turns, query.respond, served, message, question)


def metadata(loaded: LoadedModels, served: ServedModel) -> schema.ModelMetadata:
    """Describe a version and name all of its model; raise NotFoundError. Not for the event loop."""
    model = served.model
    inputs = [schema.TensorMetadata(name=each, shape=[-1, model.n_joints]) for each in schema.INPUTS]
    inputs.append(schema.TensorMetadata(name=schema.TORQUE, shape=[-1, model.n_joints], parameters={"optional": True}))
    return schema.ModelMetadata(
        name=served.name,
        versions=_known(loaded, served.name),
        platform=f"lipserve_{model.estimator.name}",
        inputs=inputs,
        outputs=[schema.TensorMetadata(name=each, shape=list(shape)) for each, shape in shapes(model).items()],
        parameters=_parameters(served, model),
    )


def _parameters(served: ServedModel, model: TorqueModel) -> dict[str, str | int]:
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


def _load(loaded: LoadedModels, name: str, version: str | None, number: int | None, alias: str | None) -> ServedModel:
    try:
        return loaded.get(name, number, alias)
    except NotFoundError as error:
        if error.detail[0].field == "model":
            raise NotFoundError(f"no model {name[:200]!r}: GET /v1/models lists all", error.detail) from error
        known = [*registry.show(loaded.database, name).aliases, *_known(loaded, name)]
        item = problem("version", version, f"one of {', '.join(known[-_LISTED:])}")
        raise NotFoundError(f"{sentence(item)}, of model {name!r}", [item]) from error


def _known(loaded: LoadedModels, name: str) -> list[str]:
    return [str(each.version) for each in registry.show(loaded.database, name).versions]

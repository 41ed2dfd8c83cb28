"""The parts of the Open Inference Protocol that HTTP and gRPC share: model lookup, metadata and inference."""

from __future__ import annotations

import re
from collections.abc import Callable
from time import perf_counter

from anyio import CapacityLimiter

from lipcore.model.torque_model import TorqueModel
from service.api.elsewhere import Elsewhere
from service.api.limits.requests import in_turn
from service.api.oip import query, schema
from service.api.oip.query import shapes
from service.api.oip.sequences import Sequences
from service.api.oip.statistics import Statistics, Timing
from service.api.oip.tensors import Message
from service.api.route import Reply
from service.contract.models import ALIAS
from service.foundation.errors import NotFoundError, NotReadyError, UnreadableVersionError, problem, sentence
from service.inference.predicting import Buffer
from service.models import registry
from service.models.loaded import LoadedModels, ServedModel
from service.models.served import AnsweringModels

MAX_INLINE_BYTES = 16 * 1024
"""Max size of a body that is decoded on the event loop: many times one query of the largest robot."""
MAX_LISTED = 20


async def find(loaded: LoadedModels, turns: CapacityLimiter, name: str, version: str | None) -> ServedModel:
    """Return a version by number or alias, the serving version if None, and load it if necessary.

    `turns` limits how many versions load at a time. Raise NotFoundError, which lists the existing versions.
    """
    number, alias = _parse_version(version)
    served = loaded.hot(name, number, alias)
    if served is not None:
        return served
    return await in_turn(turns, _load, loaded, name, version, number, alias)


async def ready(loaded: LoadedModels, turns: CapacityLimiter, name: str, version: str | None) -> ServedModel:
    """Return a version once it is in memory; raise NotFoundError, or NotReadyError if it cannot be read."""
    try:
        return await find(loaded, turns, name, version)
    except UnreadableVersionError as error:
        raise NotReadyError(error.message) from error


async def infer(
    loaded: LoadedModels,
    sequences: Sequences,
    statistics: Statistics,
    turns: CapacityLimiter,
    elsewhere: Elsewhere,
    name: str,
    version: str | None,
    body: bytes,
    decode: Callable[[], Message],
    decode_elsewhere: Callable[[Buffer], Message],
) -> Reply:
    """Answer an inference request: a single query on the event loop, a short one in a thread, any other elsewhere.

    `decode` decodes the body, `decode_elsewhere` does so in another process. Raise ServiceError for a wrong request.
    """
    settings, arrived = loaded.settings, perf_counter()
    served = await find(loaded, turns, name, version)
    timing = Timing()
    try:
        if len(body) > MAX_INLINE_BYTES:
            long = await elsewhere.run(query.infer_elsewhere, served, body, decode_elsewhere, timing)
            if long is None:  # of a sequence, whose state is here
                reply = await in_turn(turns, query.infer, served, decode, settings, sequences, arrived, timing)
        else:
            message, long = decode(), None
            task = query.read_task(served, message, settings)
            task = query.follow_sequence(served, message, task, sequences, arrived)
            timing.note_read(task.query.values.shape[1])
            if task.is_inline:
                reply = query.respond(served, message, task)
            elif task.is_long and task.deflections is None:
                long = await elsewhere.run(query.infer_elsewhere, served, body, decode_elsewhere, timing)
            else:
                reply = await in_turn(turns, query.respond, served, message, task, timing)
        if long is not None:
            reply, timing = Reply(*long[0]), long[1]
    except Exception:
        statistics.fail(served.name, served.version, timing)
        raise
    statistics.succeed(served.name, served.version, timing)
    return reply


def infer_at_once(
    loaded: AnsweringModels,
    sequences: Sequences,
    statistics: Statistics,
    name: str,
    version: str | None,
    decode: Callable[[], Message],
) -> Reply | None:
    """Answer a single query without waiting; return None for any other, and if its version is not in memory.

    Raise ServiceError for a wrong request, which is not counted.
    """
    arrived, timing = perf_counter(), Timing()
    served = loaded.hot(name, *_parse_version(version))
    if served is None:
        return None
    message = decode()
    task = query.read_task(served, message, loaded.settings)
    if not task.is_inline:
        return None
    task = query.follow_sequence(served, message, task, sequences, arrived)
    timing.note_read(task.query.values.shape[1])
    reply = query.respond(served, message, task)
    statistics.succeed(served.name, served.version, timing)
    return reply


def metadata(loaded: LoadedModels, served: ServedModel) -> schema.ModelMetadata:
    """Return the tensors of a version and the versions of its model. Blocking: use it in a thread.

    Raise NotFoundError.
    """
    model = served.model
    inputs = [schema.TensorMetadata(name=each, shape=[-1, model.n_joints]) for each in schema.INPUTS]
    inputs.append(schema.TensorMetadata(name=schema.TORQUE, shape=[-1, model.n_joints], parameters={"optional": True}))
    return schema.ModelMetadata(
        name=served.name,
        versions=_version_numbers(loaded, served.name),
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


def _parse_version(version: str | None) -> tuple[int | None, str | None]:
    """Return a version's number or an alias, or neither; number 0, which no version has, if the text is wrong."""
    if version is None:
        return None, None
    if re.fullmatch(ALIAS, version):
        return None, version
    number = int(version) if version.isascii() and version.isdigit() and len(version) < 10 else 0
    return number if str(number) == version else 0, None


def _load(loaded: LoadedModels, name: str, version: str | None, number: int | None, alias: str | None) -> ServedModel:
    try:
        return loaded.get(name, number, alias)
    except NotFoundError as error:
        if error.detail[0].field == "model":
            message = f"No model is named {name[:200]!r}. GET /v1/models lists all models."
            raise NotFoundError(message, error.detail) from error
        known = [*registry.show(loaded.database, name).aliases, *_version_numbers(loaded, name)]
        item = problem("version", version, f"one of {', '.join(known[-MAX_LISTED:])}")
        raise NotFoundError(f"{sentence(item)} of model {name!r}", [item]) from error


def _version_numbers(loaded: LoadedModels, name: str) -> list[str]:
    return [str(each.version) for each in registry.show(loaded.database, name).versions]

"""Answers to the frames of gravity, mass matrix and Coriolis torque."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anyio import to_thread

from lipcore.model.torque_model import TorqueModel
from service.contract import frames
from service.inference.gravity import explain_unavailable
from service.inference.predicting import check_answer

if TYPE_CHECKING:
    from lipcore.data.samples import Array


async def answer_part(name: str, model: TorqueModel, asked: int, motion: Array) -> tuple[int, bytes]:
    """Return flags and numbers of an answer; raise InvalidRequestError if the model has no such part.

    A model with a nonlinear term is computed in a thread, since it takes milliseconds. name: of the model; asked: flags
    of the request; motion: q, dq and ddq, (3, n).
    """
    if model.linear_bodies is not None:
        return _answer(name, model, asked, motion)
    return await to_thread.run_sync(_answer, name, model, asked, motion.copy())


def _answer(name: str, model: TorqueModel, asked: int, motion: Array) -> tuple[int, bytes]:
    with explain_unavailable(name):
        if asked & frames.ASK_MASS_MATRIX:
            return frames.HAS_MASS_MATRIX, _finite("mass_matrix", model.mass_matrix(motion[0]))
        if asked & frames.ASK_CORIOLIS:
            return frames.HAS_CORIOLIS, _finite("coriolis", model.coriolis(motion[0], motion[1]))
        found = model.gravity(motion[0])
    numbers = _finite("gravity", found.mean)
    if asked & frames.ASK_STD:
        return frames.HAS_GRAVITY | frames.HAS_STD, numbers + _finite("gravity_std", found.std)
    return frames.HAS_GRAVITY, numbers


def _finite(name: str, values: Array) -> bytes:
    check_answer(name, values)
    return values.tobytes()

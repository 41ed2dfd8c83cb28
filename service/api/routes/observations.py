"""The route of observations: decoded with msgspec and taken in a thread, away from the event loop."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from fastapi import APIRouter
from msgspec import Meta, Struct
from starlette.types import Scope

from service.api.access.scopes import UPDATE, needs
from service.api.dependencies import LearnersDep
from service.api.errors import responses
from service.api.route import Reply, hot_route, is_json
from service.contract.observations import (
    MOST_SEQUENCE,
    ExpiredError,
    ObservationRequest,
    ObservationResponse,
)
from service.foundation.errors import BusyError, ConflictError, InvalidRequestError, NotFoundError, TooLargeError
from service.foundation.json_text import each_once
from service.inference.predicting import QUANTITIES, Array, to_array
from service.learning.learners import Learners

Number = float | None
Numbers = list[Number | list[Number]]
"""One row or many; that it is one of the two, and not some of each, is left to be checked."""


class Batch(Struct, forbid_unknown_fields=True):
    """An ObservationRequest as JSON has it, but that the rows are left to be read: the interpreter's lock is let go in
    between, which others wait for, maybe a control loop. Shapes are left to be checked."""

    stream_id: Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}\Z")]
    sequence: Annotated[int, Meta(ge=0, le=MOST_SEQUENCE)]
    q: msgspec.Raw
    dq: msgspec.Raw
    tau: msgspec.Raw
    ddq: msgspec.Raw = msgspec.Raw()
    t: float | list[Number] | None = None
    joint_names: Annotated[list[str], Meta(max_length=1000)] | None = None

    def request(self) -> ObservationRequest | None:
        """Return the request with arrays, null as NaN, or None where rows are none, empty or ragged."""
        arrays: dict[str, Array | None] = {"ddq": None}
        try:
            for name in QUANTITIES:
                raw = bytes(getattr(self, name))
                if name != "ddq" or raw not in (b"", b"null"):
                    arrays[name] = to_array(_numbers.decode(raw))
            if self.t is not None:
                arrays["t"] = np.atleast_1d(np.array(self.t, np.float64))
        except (ValueError, msgspec.MsgspecError):
            return None
        return ObservationRequest.model_construct(**(msgspec.structs.asdict(self) | arrays))

    def names(self) -> int:
        """How many fields the JSON has, where each is there once; those that are null need not be among them."""
        values = (getattr(self, name) for name in self.__struct_fields__)
        return sum(value is not None and value != _ABSENT for value in values)


_ABSENT = msgspec.Raw()
_decoder, _numbers = msgspec.json.Decoder(Batch), msgspec.json.Decoder(Numbers)
_FIELDS = tuple(name.encode() for name in Batch.__struct_fields__)


def decode(body: bytes) -> ObservationRequest | None:
    """Decode a batch, or return None where anything in it is not as it should be."""
    try:
        batch = _decoder.decode(body)
    except (msgspec.MsgspecError, RecursionError):
        return None
    # what is there has two quotes for its name, and strings have two more: no other quotes, no field twice
    quotes = 2 * (batch.names() + 1 + len(batch.joint_names or ()))
    clear = b"\\" not in body and body.count(b'"') == quotes
    return batch.request() if clear or each_once(body, *_FIELDS) else None


hot = APIRouter(
    prefix="/v1/models",
    tags=["learning"],
    responses=responses(
        InvalidRequestError,
        NotFoundError,
        TooLargeError,
        ConflictError,
        ExpiredError,
        BusyError,
    ),
)
"""The application tries it first: what pydantic takes long to read is decoded in a thread."""


async def _answer(scope: Scope, body: bytes) -> Reply | None:
    """Take a batch that can be read as it stands."""
    if not is_json(scope):
        return None
    learners: Learners = scope["app"].state.learners
    model = scope["path_params"]["model"]
    reply = await learners.threads.run(model, _decoded, learners, model, body)
    return None if reply is None else Reply(reply)


def _decoded(learners: Learners, model: str, body: bytes) -> bytes | None:
    request = decode(body)
    return None if request is None else learners.observe(model, request).model_dump_json().encode()


@needs(UPDATE)
async def observe(learners: LearnersDep, model: str, request: ObservationRequest) -> ObservationResponse:
    """Take a batch of measured rows to learn from, durable once it is answered, and learnt within a moment.

    Each row is predicted before it is learnt. Rows that cannot be explained are kept and counted, but not learnt. Send
    a batch again until it is answered: it is applied once. Batches may come in any order. Times must rise within a
    stream; a robot whose clock was set goes on under another `stream_id`. Of joints in another order, say
    `joint_names`. Batches of about a tenth of a second to a second serve best.
    """
    return await learners.threads.run(model, learners.observe, model, request)


hot.add_api_route(
    "/{model}/observations",
    observe,
    methods=["POST"],
    summary="Teach a model with measured rows",
    response_model=ObservationResponse,
    route_class_override=hot_route(_answer),
)

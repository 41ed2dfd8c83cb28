"""Observations as bytes: what their route decodes and encodes, with msgspec, away from the event loop."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from service.learning.schema import MOST_SEQUENCE, ObservationRequest
from service.web.route import each_once

Array = NDArray[np.float64]
Number = float | None
Numbers = list[Number | list[Number]]
"""One row or many; that it is one of the two, and not some of each, is left to be checked."""


class Batch(Struct, forbid_unknown_fields=True):
    """An ObservationRequest as it comes: types are right, shapes are left to be checked."""

    stream_id: Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}\Z")]
    sequence: Annotated[int, Meta(ge=0, le=MOST_SEQUENCE)]
    q: Numbers
    dq: Numbers
    tau: Numbers
    ddq: Numbers | None = None
    t: float | list[Number] | None = None
    joint_names: Annotated[list[str], Meta(max_length=1000)] | None = None

    def request(self) -> ObservationRequest | None:
        """Return what it says with arrays, null as NaN, or None where a list is empty or ragged."""
        try:
            return ObservationRequest.model_construct(
                stream_id=self.stream_id,
                sequence=self.sequence,
                t=None if self.t is None else np.atleast_1d(np.array(self.t, np.float64)),
                q=_array(self.q),
                dq=_array(self.dq),
                ddq=None if self.ddq is None else _array(self.ddq),
                tau=_array(self.tau),
                joint_names=self.joint_names,
            )
        except ValueError:
            return None


_decoder = msgspec.json.Decoder(Batch)
_FIELDS = tuple(name.encode() for name in Batch.__struct_fields__)


def decode(body: bytes) -> ObservationRequest | None:
    """Decode a batch, or return None where anything in it is not as it should be."""
    try:
        batch = _decoder.decode(body)
    except msgspec.MsgspecError:
        return None
    return batch.request() if each_once(body, *_FIELDS) else None


def _array(values: Numbers) -> Array:
    if not values:
        raise ValueError("no rows")
    return np.array(values, np.float64)

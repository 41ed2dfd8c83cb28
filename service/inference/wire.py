"""Queries and answers as bytes: what the hot route decodes and encodes, with msgspec."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from lipcore.vocabulary import ComponentName, TorqueConvention
from service.inference.schema import PredictRequest
from service.models.schema import ALIAS
from service.web.route import each_once

Array = NDArray[np.float64]
_ALIAS = ALIAS.replace("$", r"\Z")  # Python's own expressions let a line end follow
Numbers = list[float | list[float]]
"""One query or a batch; that it is one of the two, and not some of each, is left to be checked."""


class Query(Struct, forbid_unknown_fields=True):
    """A PredictRequest as it comes: types are right and numbers finite, shapes are left to be checked."""

    q: Numbers
    dq: Numbers
    ddq: Numbers
    version: Annotated[int, Meta(ge=1, lt=2**31)] | None = None
    alias: Annotated[str, Meta(pattern=_ALIAS)] | None = None
    covariance: bool = False
    components: list[ComponentName] = []
    tau: Numbers | None = None
    min_revision: Annotated[int, Meta(ge=0, lt=2**31)] | None = None

    def single(self) -> Array | None:
        """Return the motion (3, n) where this is one query for a torque and no more."""
        batch = bool(self.q) and isinstance(self.q[0], list)
        if batch or self.covariance or self.components or self.tau is not None:
            return None
        try:
            return np.array((self.q, self.dq, self.ddq), np.float64)
        except ValueError:  # shapes differ
            return None

    def request(self) -> PredictRequest | None:
        """Return what it says with arrays (n,) or (N, n), or None where a list is ragged or a component comes twice."""
        q, dq, ddq = _array(self.q), _array(self.dq), _array(self.ddq)
        tau = None if self.tau is None else _array(self.tau)
        if q is None or dq is None or ddq is None or (tau is None and self.tau is not None):
            return None
        if len(set(self.components)) < len(self.components):
            return None
        return PredictRequest.model_construct(
            q=q,
            dq=dq,
            ddq=ddq,
            tau=tau,
            version=self.version,
            alias=self.alias,
            covariance=self.covariance,
            components=self.components,
            min_revision=self.min_revision,
        )


class Prediction(Struct, omit_defaults=True):
    """A PredictResponse as it goes out; what was not asked for is left out."""

    model: str
    version: int
    revision: int
    joint_names: tuple[str, ...]
    torque_convention: TorqueConvention
    tau: list[Any]
    tau_std: list[Any]
    noise_std: list[float]
    covariance: list[Any] | None = None
    components: dict[ComponentName, dict[str, Any]] | None = None


_decoder = msgspec.json.Decoder(Query)
_FIELDS = tuple(name.encode() for name in Query.__struct_fields__)
_encoder = msgspec.json.Encoder()


def decode(body: bytes) -> Query | None:
    """Decode a query, or return None where anything in it is not as it should be."""
    try:
        query = _decoder.decode(body)
    except msgspec.MsgspecError:
        return None
    if query.alias is not None and query.version is not None:
        return None
    # the usual query has the quotes of q, dq and ddq, which are all there, and no others
    return query if body.count(b'"') == 6 or each_once(body, *_FIELDS) else None


def encode(answer: Prediction) -> bytes:
    """Encode an answer; its numbers read back are the same numbers."""
    return _encoder.encode(answer)


def _array(values: Numbers) -> Array | None:
    try:
        return np.array(values, np.float64) if values else None
    except ValueError:  # ragged
        return None

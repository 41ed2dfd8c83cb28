"""From a request to measurements in the model's own joint order, with errors that name what is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array
from lipcore.model.torque_model import TorqueModel
from service.foundation.errors import invalid_request
from service.foundation.settings import Settings
from service.learning.schema import ObservationRequest


@dataclass(frozen=True)
class Measured:
    """N rows as they came, in the model's joint order. t: (N,) by the stream's clock, s; the others (N, n), SI."""

    t: Array | None
    q: Array
    dq: Array
    ddq: Array | None
    tau: Array

    def __len__(self) -> int:
        return len(self.q)


def measured(request: ObservationRequest, model: TorqueModel, settings: Settings) -> Measured:
    """Check a request's shapes and joints and bring its columns in order; raise InvalidRequestError."""
    shape = request.q.shape
    for name in ("q", "dq", "ddq", "tau"):
        values = getattr(request, name)
        if values is None:
            continue
        if values.shape[-1] != model.n_joints:
            expected = f"{model.n_joints} numbers: {', '.join(model.joint_names)}"
            raise invalid_request(name, f"{values.shape[-1]} numbers long", expected)
        if values.shape != shape:
            raise invalid_request(name, f"of shape {values.shape}", f"the shape of q, {shape}")
    rows = 1 if request.q.ndim == 1 else len(request.q)
    if rows > settings.max_observation_rows:
        raise invalid_request("q", f"{rows} rows", f"at most {settings.max_observation_rows} in one batch")
    if request.t is not None and request.t.shape != (rows,):
        raise invalid_request("t", f"{len(request.t)} numbers long", f"{rows}, one a row of q")
    if request.t is None and request.ddq is None:
        raise invalid_request("ddq", "missing, and t too", "accelerations, or times to derive them from dq with")
    order = slice(None) if request.joint_names is None else columns(request.joint_names, model.joint_names)
    q, dq, ddq, tau = (
        None if values is None else np.ascontiguousarray(np.atleast_2d(values)[:, order])
        for values in (request.q, request.dq, request.ddq, request.tau)
    )
    assert q is not None
    assert dq is not None
    assert tau is not None
    return Measured(request.t, q, dq, ddq, tau)


def columns(given: Sequence[str], wanted: Sequence[str]) -> list[int]:
    """Place of each of the model's joints among those given; raise InvalidRequestError naming what does not fit."""
    for index, name in enumerate(given):
        if name not in wanted:
            raise invalid_request(f"joint_names[{index}]", name, f"one of the model's joints: {', '.join(wanted)}")
        if name in given[:index]:
            raise invalid_request(f"joint_names[{index}]", name, "each joint once")
    if missing := [name for name in wanted if name not in given]:
        raise invalid_request("joint_names", f"without {', '.join(missing)}", "all of the model's joints")
    return [given.index(name) for name in wanted]

"""Reads the numbers of request frames."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

import numpy as np

from service.contract import frames
from service.foundation.errors import invalid_request
from service.inference.predicting import Query

if TYPE_CHECKING:
    from lipcore.data.samples import Array


WITH = {1: " with q alone", 2: " with q and dq", 3: "", 4: " with tau"}
"""Descriptions of a frame by its number of vectors, for errors."""


class FrameReader:
    """Reads frames of one robot into a buffer, which the next frame overwrites."""

    def __init__(self, joint_names: tuple[str, ...], position_limits: Array) -> None:
        self.joint_names, self.n_joints, self._limits = joint_names, len(joint_names), position_limits
        self.motion: Array = np.zeros((3, self.n_joints))
        self._numbers, self._query = self.motion.reshape(-1), Query(self.motion[:, None], single=True)
        self._lengths = {flags: frames.request_bytes(self.n_joints, flags) for flags in frames.VECTORS}

    def read(self, data: bytes, flags: int, n: int, budget: float) -> Array:
        """Return q, dq, ddq of a frame with a header that was read before, (3, n); raise InvalidRequestError.

        Vectors that the flags do not need are zero. The values of the torque are not checked: see `torque`.
        """
        if n != self.n_joints:
            raise invalid_request("n", n, f"{self.n_joints} joints: {', '.join(self.joint_names)}")
        vectors = frames.VECTORS.get(flags)
        if vectors is None:
            expected = (
                f"a sum of {frames.ASK_STD} (return tau_std), {frames.ASK_LEARN} (learn from tau) and "
                f"{frames.ASK_EXTERNAL} (return the external torque); or {frames.ASK_GRAVITY} (gravity), "
                f"{frames.ASK_GRAVITY | frames.ASK_STD} (gravity and its standard deviation), "
                f"{frames.ASK_MASS_MATRIX} (mass matrix) or {frames.ASK_CORIOLIS} (Coriolis torque)"
            )
            raise invalid_request("flags", flags, expected)
        length = self._lengths[flags]
        if len(data) != length:
            expected = f"{length} bytes for {n} joints{WITH[vectors]}"
            raise invalid_request("frame", f"{len(data)} bytes long", expected)
        if not 0.0 <= budget < inf:
            raise invalid_request("deadline", budget, "a number of seconds, or 0 for none")
        # a copy: the model needs aligned, writable memory, which the message may not be
        given = min(vectors, 3) * n
        self._numbers[:given] = np.frombuffer(data, frames.NUMBER, given, frames.REQUEST.size)
        self._numbers[given:] = 0.0
        self._query.check(self._limits)
        return self.motion

    def torque(self, data: bytes) -> Array:
        """Return tau, (n,), of a frame checked by `read`; raise InvalidRequestError if it is not finite."""
        tau = np.array(np.frombuffer(data, frames.NUMBER, self.n_joints, self._lengths[0]), np.float64)
        finite = np.isfinite(tau)
        if not finite.all():
            joint = int(finite.argmin())
            raise invalid_request(f"tau[{joint}]", f"{tau[joint]:g}", "a finite number")
        return tau

"""Request frames into motions, with errors that name what is wrong."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

import numpy as np

from service.foundation.errors import InvalidRequestError, invalid_request
from service.inference import checks
from service.stream.frames import ASK_LEARN, ASK_STD, NUMBER, REQUEST, request_bytes

if TYPE_CHECKING:
    from lipcore.data.samples import Array

FIELDS = ("q", "dq", "ddq")


class FrameReader:
    """Reads frames of one robot into a single buffer, which the next frame overwrites."""

    def __init__(self, joint_names: tuple[str, ...], max_position: float) -> None:
        self.joint_names, self.n_joints, self.max_position = joint_names, len(joint_names), max_position
        self.motion: Array = np.zeros((3, self.n_joints))
        self._numbers, self._positions = self.motion.reshape(-1), self.motion[0]
        self._length = request_bytes(self.n_joints)
        self._learn_length = request_bytes(self.n_joints, learn=True)

    def read(self, data: bytes, flags: int, n: int, budget: float) -> Array:
        """Return q, dq, ddq of a frame, (3, n), whose header is already read; raise InvalidRequestError.

        Torque that it carries must be there, and is not looked at.
        """
        if n != self.n_joints:
            raise invalid_request("n", n, f"{self.n_joints} joints: {', '.join(self.joint_names)}")
        if flags > ASK_STD:
            data = self._without_torque(data, flags)
        if len(data) != self._length:
            raise invalid_request("frame", f"{len(data)} bytes long", f"{self._length} bytes for {n} joints")
        if not 0.0 <= budget < inf:
            raise invalid_request("deadline", budget, "seconds, or 0 for none")
        # a copy, because the model takes aligned and writable memory, and the message is neither for certain
        self._numbers[:] = np.frombuffer(data, NUMBER, offset=REQUEST.size)
        if not np.isfinite(self._numbers).all():
            raise self._not_finite()
        checks.positions(self._positions, self.max_position)
        return self.motion

    def _without_torque(self, data: bytes, flags: int) -> bytes:
        if flags & ~(ASK_STD | ASK_LEARN):
            expected = f"0, {ASK_STD} to be answered tau_std, {ASK_LEARN} to be learnt from, or {ASK_STD | ASK_LEARN}"
            raise invalid_request("flags", flags, expected)
        if len(data) != self._learn_length:
            expected = f"{self._learn_length} bytes for {self.n_joints} joints with tau"
            raise invalid_request("frame", f"{len(data)} bytes long", expected)
        return data[: self._length]

    def _not_finite(self) -> InvalidRequestError:
        row, joint = np.argwhere(~np.isfinite(self.motion))[0]
        return invalid_request(checks.element(FIELDS[row], joint), f"{self.motion[row, joint]:g}", "a finite number")

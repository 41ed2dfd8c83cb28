"""A stream of torque queries to one model, some of which carry torque to learn from."""

from __future__ import annotations

import json
import logging
from math import inf
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
from anyio import to_thread
from starlette.types import Message, Receive, Send

from service.foundation.errors import ErrorBody, ErrorResponse, ServiceError, invalid_request
from service.inference.predicting import Query, check_answer
from service.learning.learners import Learners
from service.models.loaded import Served
from service.models.moves import SERVING
from service.stream.conversation import Conversation
from service.stream.frames import (
    ANSWER,
    ASK_LEARN,
    ASK_STD,
    ERROR,
    HAS_STD,
    LATE,
    LAYOUT,
    NUMBER,
    REQUEST,
    UNREAD,
    request_bytes,
)
from service.stream.learning import Learning, Taught
from service.web.observability.meters import StreamMeter
from service.web.server.connections import StreamProtocol

if TYPE_CHECKING:
    from lipcore.data.samples import Array


class FrameReader:
    """Reads frames of one robot into a single buffer, which the next frame overwrites."""

    def __init__(self, joint_names: tuple[str, ...], max_position: float) -> None:
        self.joint_names, self.n_joints, self.max_position = joint_names, len(joint_names), max_position
        self.motion: Array = np.zeros((3, self.n_joints))
        self._numbers, self._query = self.motion.reshape(-1), Query(self.motion[:, None], single=True)
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
        self._query.check(self.max_position)
        return self.motion

    def _without_torque(self, data: bytes, flags: int) -> bytes:
        if flags & ~(ASK_STD | ASK_LEARN):
            expected = f"0, {ASK_STD} to be answered tau_std, {ASK_LEARN} to be learnt from, or {ASK_STD | ASK_LEARN}"
            raise invalid_request("flags", flags, expected)
        if len(data) != self._learn_length:
            expected = f"{self._learn_length} bytes for {self.n_joints} joints with tau"
            raise invalid_request("frame", f"{len(data)} bytes long", expected)
        return data[: self._length]


logger = logging.getLogger(__name__)


class Session(Conversation):
    """Answers every frame from the version that is current when the frame is taken; holds that version in memory.

    meter: counts what it answers; pinned: whether it stays with this version; std: whether every answer carries
    tau_std; stream_id: source of the torques that frames carry, None where they carry none; alias: that it follows,
    None: the version that serves.
    """

    def __init__(
        self,
        connection: StreamProtocol,
        receive: Receive,
        send: Send,
        learners: Learners,
        served: Served,
        meter: StreamMeter,
        pinned: bool,
        std: bool,
        stream_id: str | None = None,
        alias: str | None = None,
    ) -> None:
        super().__init__(connection, receive, send, learners.settings)
        self._loaded, self._name = learners.loaded, served.name
        self._pin = served.version if pinned else None
        self._alias = None if alias == SERVING else alias
        self._std, self._late, self._due = std, 0, inf
        self._meter, self._deadline = meter, learners.settings.stream_deadline_s
        self._learning = None if stream_id is None else Learning(learners, stream_id, self.say)
        self._take(served)

    async def run(self) -> None:
        """Talk until either side ends it; what was taught until then is logged all the same."""
        try:
            await super().run()
        finally:
            if self._learning is not None:
                await self._learning.close()
                self._learning = None  # which refers to this: no cycles, see StreamProtocol

    async def greet(self) -> None:
        """Send what holds for all answers of the version."""
        model = self._served.model
        hello = {
            "layout": LAYOUT,
            "model": self._served.name,
            "version": self._served.version,
            "revision": self._served.revision,
            "joint_names": list(model.joint_names),
            "torque_convention": model.torque_convention,
            "noise_std": self._served.noise_std,
            "max_position": self.settings.max_position,
        }
        await self.send({"type": "websocket.send", "text": json.dumps(hello)})

    async def reply(self, message: Message, arrived: float) -> bytes:
        """Return the answer frame; whatever is wrong becomes an error frame."""
        if self.left > self._due:  # the last answer left in time, but its client did not read it
            self._late += 1
            self._meter.late += 1
        self._due = inf
        sequence, flags = 0, UNREAD
        try:
            data = message.get("bytes")
            if data is None:
                raise invalid_request("frame", "a text message", "a binary message")
            if len(data) < REQUEST.size:
                expected = f"a header of {REQUEST.size} bytes, and numbers"
                raise invalid_request("frame", f"{len(data)} bytes long", expected)
            sequence, asked, n, budget = REQUEST.unpack_from(data)
            flags = 0
            current = self._loaded.hot(self._name, self._pin, self._alias)
            if current is not self._served:
                await self._follow(current)
            motion = self._reader.read(data, asked, n, budget)
            if asked > ASK_STD:
                await self._admit(sequence, asked)
            tau, std = self._answer(motion, self._std or asked != 0)
            check_answer("tau", tau)
            if std is not None:
                check_answer("tau_std", std)
        except ServiceError as error:
            return self._refuse(sequence, flags, arrived, error)
        except Exception as error:  # the next frame may be answered
            logger.error("unexpected error in a stream of model %s", self._name, exc_info=error)
            unexpected = ServiceError("an unexpected error; the service's log says more")
            return self._refuse(sequence, flags, arrived, unexpected)
        served, numbers = self._served, tau.tobytes()
        if std is not None:
            flags = HAS_STD
            numbers += std.tobytes()
        if asked > ASK_STD:
            assert self._learning is not None
            self._learning.add(Taught(served, sequence, arrived, data, numbers))
            if asked == ASK_LEARN and not self._std:  # its standard deviation is for the record alone
                flags, numbers = 0, tau.tobytes()
        now = perf_counter()
        seconds = now - arrived
        self._meter.durations.add(seconds)
        if budget:
            self._due = arrived + budget
            if now > self._due:
                self._late, self._due = self._late + 1, inf
                self._meter.late += 1
                flags |= LATE
        elif seconds > self._deadline:
            self._meter.late += 1
        return ANSWER.pack(sequence, flags, n, served.version, self._late, served.revision, seconds) + numbers

    async def _admit(self, sequence: int, flags: int) -> None:
        """Wait until there is room for a frame to learn from; raise InvalidRequestError where it may not be learnt."""
        if self._pin is not None:
            expected = f"no {ASK_LEARN}: a stream pinned to a version only asks; leave version out of the address"
            raise invalid_request("flags", flags, expected)
        if self._alias is not None:
            expected = f"no {ASK_LEARN}: only the version that serves learns; leave alias out of the address"
            raise invalid_request("flags", flags, expected)
        if self._learning is None:
            expected = f"a name of the torque's source in the address, as in ?stream_id=arm-1, for flag {ASK_LEARN}"
            raise invalid_request("stream_id", "missing", expected)
        await self._learning.admit(sequence)

    def _refuse(self, sequence: int, flags: int, arrived: float, error: ServiceError) -> bytes:
        self._meter.refuse(error.code)
        body = ErrorResponse(error=ErrorBody(code=error.code, message=error.message, detail=error.detail))
        served, seconds = self._served, perf_counter() - arrived
        header = ANSWER.pack(sequence, flags | ERROR, 0, served.version, self._late, served.revision, seconds)
        return header + body.model_dump_json().encode()

    async def _follow(self, current: Served | None) -> None:
        """Take the version that is current; None: it has been dropped from memory, maybe for a newer one.

        Raise NotFoundError where the version, the alias or the model has been deleted.
        """
        if current is None:
            meant = self._loaded.newest(self._name, self._alias) if self._pin is None else self._pin
            if meant == self._served.version and not self._loaded.is_deleted(self._name, meant):
                return  # it is held here
            current = await to_thread.run_sync(self._loaded.get, self._name, self._pin, self._alias)
        known = self._served.version
        self._take(current)
        if current.version != known:
            await self.greet()

    def _take(self, served: Served) -> None:
        self._served, self._answer = served, served.model.answer
        self._reader = FrameReader(served.model.joint_names, self.settings.max_position)

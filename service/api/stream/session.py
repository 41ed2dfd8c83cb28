"""One WebSocket connection: a message in, a message out, in order, and an end to clients that are gone; and streams of
torque queries to one model, some of which carry torque to learn from."""

from __future__ import annotations

import asyncio
import json
import logging
from abc import ABC, abstractmethod
from collections import deque
from contextlib import suppress
from math import inf, nan
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
from anyio import to_thread
from starlette.types import Message, Receive, Send

from lipcore.model.external import external
from service.api.access.middleware import subprotocol_of
from service.api.limits.requests import PATIENCE
from service.api.server.connections import StreamProtocol
from service.api.stream.learning import Learning, Taught
from service.contract import frames
from service.foundation.errors import ErrorBody, ErrorResponse, ServiceError, invalid_request
from service.foundation.settings import Settings
from service.inference.predicting import Query, check_answer
from service.learning.learners import Learners
from service.models.loaded import ServedModel
from service.models.registry import SERVING
from service.telemetry.meters import StreamMeter

if TYPE_CHECKING:
    from lipcore.data.samples import Array

logger = logging.getLogger(__name__)


class Conversation(ABC):
    """Answers messages one by one, reading the next when the answer is written.

    ASGI's own calls rather than Starlette's WebSocket: that costs 3 µs a message, 1 µs as here.
    left: when the last answer had been written, in seconds of `time.perf_counter`.
    """

    def __init__(self, connection: StreamProtocol, receive: Receive, send: Send, settings: Settings) -> None:
        self.connection, self.receive, self.send, self.settings = connection, receive, send, settings
        self.left = perf_counter()
        self._writing = False
        self._texts: deque[str] = deque()
        self._closing: asyncio.Task[None] | None = None

    @abstractmethod
    async def reply(self, message: Message, arrived: float) -> bytes:
        """Return the answer to a message that arrived at a time of `time.perf_counter`."""

    async def greet(self) -> None:
        """Say what a client has to know before it asks."""
        return

    async def run(self) -> None:
        """Accept the connection and talk until either side ends it."""
        receive, send, connection, reply = self.receive, self.send, self.connection, self.reply
        await receive()
        await send({"type": "websocket.accept", "subprotocol": subprotocol_of(connection.scope["subprotocols"])})
        await self.greet()
        self._watch()
        try:
            while True:
                message = await receive()
                arrived = connection.arrived
                if message["type"] == "websocket.disconnect":
                    return
                answer = await reply(message, arrived)
                self._writing = True
                self.left = perf_counter()  # since when the answer waits, should it have to
                await send({"type": "websocket.send", "bytes": answer})
                self.left = perf_counter()
                if self._texts:
                    await self._write_texts()
                self._writing = False
                # neither call above lets others run when messages wait: a client that sends many must not hold up all
                await asyncio.sleep(0)
        finally:
            self._timer.cancel()

    async def send_text(self, text: str) -> None:
        """Send a text between answers: now, or after the answer that is being written. One caller at a time. A client
        that does not read it is cut off as one that does not read its answers; one that is gone misses it."""
        self._texts.append(text)
        if self._writing:
            return
        with suppress(OSError, RuntimeError):  # gone, or closing, which uvicorn says in its own way
            try:
                async with asyncio.timeout(PATIENCE.frame_s):
                    await self._write_texts()
            except TimeoutError:
                self.connection.abort()

    async def _write_texts(self) -> None:
        while self._texts:
            await self.send({"type": "websocket.send", "text": self._texts.popleft()})

    def _watch(self) -> None:
        period = min(self.settings.stream_idle_s, PATIENCE.frame_s)
        self._timer = asyncio.get_running_loop().call_later(period, self._look)

    def _look(self) -> None:
        """End a connection that is idle or does not read. Looked at now and then: a timer a frame costs time."""
        waited = perf_counter() - self.left
        if self._writing and waited >= PATIENCE.frame_s:
            self.connection.abort()
        elif not self._writing and waited >= self.settings.stream_idle_s:
            self._closing = asyncio.get_running_loop().create_task(self._close_idle())
        else:
            self._watch()

    async def _close_idle(self) -> None:
        reason = f"no frame for {self.settings.stream_idle_s:g} s (LIPSERVE_STREAM_IDLE_S)"
        with suppress(OSError):  # gone already
            await self.send({"type": "websocket.close", "code": 1000, "reason": reason})


class Echo(Conversation):
    """Sends back what comes: the floor that answers are compared with."""

    async def reply(self, message: Message, arrived: float) -> bytes:
        """Return the message itself."""
        text = message.get("text")
        data: bytes = message["bytes"] if text is None else text.encode()
        return data


class FrameReader:
    """Reads frames of one robot into a single buffer, which the next frame overwrites."""

    def __init__(self, joint_names: tuple[str, ...], position_limits: Array) -> None:
        self.joint_names, self.n_joints, self._limits = joint_names, len(joint_names), position_limits
        self.motion: Array = np.zeros((3, self.n_joints))
        self._numbers, self._query = self.motion.reshape(-1), Query(self.motion[:, None], single=True)
        self._lengths = {torque: frames.request_bytes(self.n_joints, torque) for torque in (False, True)}

    def read(self, data: bytes, flags: int, n: int, budget: float) -> Array:
        """Return q, dq, ddq of a frame, (3, n), whose header is already read; raise InvalidRequestError. Torque that it
        carries must be there, and is not looked at: see `torque`."""
        if n != self.n_joints:
            raise invalid_request("n", n, f"{self.n_joints} joints: {', '.join(self.joint_names)}")
        if flags >= 2 * frames.ASK_EXTERNAL:
            expected = (
                f"a sum of {frames.ASK_STD} to be answered tau_std, {frames.ASK_LEARN} to be learnt from, and "
                f"{frames.ASK_EXTERNAL} to be answered the external torque"
            )
            raise invalid_request("flags", flags, expected)
        length = self._lengths[torque := flags > frames.ASK_STD]
        if len(data) != length:
            expected = f"{length} bytes for {n} joints{' with tau' if torque else ''}"
            raise invalid_request("frame", f"{len(data)} bytes long", expected)
        if not 0.0 <= budget < inf:
            raise invalid_request("deadline", budget, "seconds, or 0 for none")
        # a copy, because the model takes aligned and writable memory, and the message is neither for certain
        self._numbers[:] = np.frombuffer(data, frames.NUMBER, 3 * n, frames.REQUEST.size)
        self._query.check(self._limits)
        return self.motion

    def torque(self, data: bytes) -> Array:
        """Return tau, (n,), of a frame that has been read; raise InvalidRequestError where it is not finite."""
        tau = np.array(
            np.frombuffer(data, frames.NUMBER, self.n_joints, self._lengths[False]), np.float64
        )  # see `read`
        finite = np.isfinite(tau)
        if not finite.all():
            joint = int(finite.argmin())
            raise invalid_request(f"tau[{joint}]", f"{tau[joint]:g}", "a finite number")
        return tau


class Session(Conversation):
    """Answers every frame from the version that is current when the frame is taken; holds that version in memory.

    meter: counts what it answers; pinned: whether it stays with this version; std: whether every answer carries
    tau_std; stream_id: source of the torques that frames carry, None where they carry none; alias: that it follows,
    None: the version that serves; scale, payload: whether every answer carries the factor on its intervals, and
    what the arm carries.
    """

    def __init__(
        self,
        connection: StreamProtocol,
        receive: Receive,
        send: Send,
        learners: Learners,
        served: ServedModel,
        meter: StreamMeter,
        pinned: bool,
        std: bool,
        stream_id: str | None = None,
        alias: str | None = None,
        scale: bool = False,
        payload: bool = False,
    ) -> None:
        super().__init__(connection, receive, send, learners.settings)
        self._loaded, self._name = learners.loaded, served.name
        self._pin = served.version if pinned else None
        self._alias = None if alias == SERVING else alias
        self._std, self._late = std, 0
        self._scale, self._payload, self._stream_id = scale, payload, stream_id
        self._meter, self._deadline = meter, learners.settings.stream_deadline_s
        self._learning = None if stream_id is None else Learning(learners, stream_id, self.send_text)
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
            "layout": frames.LAYOUT,
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
        sequence, flags = 0, frames.UNREAD
        try:
            data = message.get("bytes")
            if data is None:
                raise invalid_request("frame", "a text message", "a binary message")
            if len(data) < frames.REQUEST.size:
                expected = f"a header of {frames.REQUEST.size} bytes, and numbers"
                raise invalid_request("frame", f"{len(data)} bytes long", expected)
            sequence, asked, n, budget = frames.REQUEST.unpack_from(data)
            flags = 0
            current = self._loaded.hot(self._name, self._pin, self._alias)
            if current is not self._served or self._loads.model_for(self._stream_id) is not self._carried:
                await self._follow(current)
            motion = self._reader.read(data, asked, n, budget)
            if asked & frames.ASK_LEARN:
                await self._admit(sequence, asked)
            compares = asked >= frames.ASK_EXTERNAL
            tau, std, covariance, fallback = self._answer(motion, self._std or asked != 0, compares)
            check_answer("tau", tau)
            if std is not None:
                check_answer("tau_std", std)
            factor, more = self._served.scales.of(self._stream_id), b""
            mean = tau if fallback is None else fallback.mean  # for learning and external torque
            if compares:
                more = self._external(data, mean, std, covariance, factor)
        except ServiceError as error:
            return self._refuse(sequence, flags, arrived, error)
        except Exception as error:  # the next frame may be answered
            logger.error("unexpected error in a stream of model %s", self._name, exc_info=error)
            unexpected = ServiceError("an unexpected error; the service's log says more")
            return self._refuse(sequence, flags, arrived, unexpected)
        served = self._served
        flags, numbers = self._numbers(sequence, asked, arrived, data, tau, std, factor, more, mean)
        if fallback is not None:
            flags |= frames.FALLBACK
        seconds = perf_counter() - arrived
        self._meter.durations.add(seconds)
        if seconds > (budget or self._deadline):
            self._meter.late += 1
            if budget:
                self._late, flags = self._late + 1, flags | frames.LATE
        return frames.ANSWER.pack(sequence, flags, n, served.version, self._late, served.revision, seconds) + numbers

    async def _admit(self, sequence: int, flags: int) -> None:
        """Wait until there is room for a frame to learn from; raise InvalidRequestError where it may not be learnt."""
        if self._pin is not None:
            expected = (
                f"no {frames.ASK_LEARN}: a stream pinned to a version only asks; leave version out of the address"
            )
            raise invalid_request("flags", flags, expected)
        if self._alias is not None:
            expected = f"no {frames.ASK_LEARN}: only the version that serves learns; leave alias out of the address"
            raise invalid_request("flags", flags, expected)
        if self._learning is None:
            expected = (
                f"a name of the torque's source in the address, as in ?stream_id=arm-1, for flag {frames.ASK_LEARN}"
            )
            raise invalid_request("stream_id", "missing", expected)
        await self._learning.admit(sequence)

    def _external(self, data: bytes, mean: Array, std: Array | None, covariance: Array | None, factor: Array) -> bytes:
        """Numbers of the external torque of a frame; raise InvalidRequestError."""
        assert std is not None  # both are asked for
        assert covariance is not None
        measured, noise_std = self._reader.torque(data), self._noise_std
        seen = external(measured[None], mean[None], std[None], noise_std, factor, covariance[None])
        check_answer("tau_external_statistic", seen.statistic)  # no z² is larger
        return seen.rows.tobytes()

    def _numbers(
        self,
        sequence: int,
        asked: int,
        arrived: float,
        data: bytes,
        tau: Array,
        std: Array | None,
        factor: Array,
        external: bytes,
        mean: Array,
    ) -> tuple[int, bytes]:
        """Flags and numbers of an answer. A frame to learn from is gathered with the posterior mean at that time."""
        flags, numbers = 0, tau.tobytes()
        if std is not None:
            flags, numbers = frames.HAS_STD, numbers + std.tobytes()
        if asked > frames.ASK_STD:
            if asked & frames.ASK_LEARN:
                assert self._learning is not None  # the frame was admitted
                assert std is not None  # every flag asks for it
                posterior = mean.tobytes() + std.tobytes()
                self._learning.add(
                    Taught(self._served, self._carried is not None, sequence, arrived, data, posterior, factor)
                )
            if not (asked & frames.ASK_STD or self._std):  # its standard deviation was for the record, or the test
                flags, numbers = 0, tau.tobytes()
        if self._scale:
            flags, numbers = flags | frames.HAS_SCALE, numbers + factor.tobytes()
        if external:
            flags, numbers = flags | frames.HAS_EXTERNAL, numbers + external
        if self._payload:
            carried = self._loads.mass(self._stream_id) or (nan, nan)
            flags, numbers = flags | frames.HAS_PAYLOAD, numbers + np.array(carried).tobytes()
        return flags, numbers

    def _refuse(self, sequence: int, flags: int, arrived: float, error: ServiceError) -> bytes:
        self._meter.refuse(error.code)
        body = ErrorResponse(error=ErrorBody(code=error.code, message=error.message, detail=error.detail))
        served, seconds = self._served, perf_counter() - arrived
        header = frames.ANSWER.pack(
            sequence, flags | frames.ERROR, 0, served.version, self._late, served.revision, seconds
        )
        return header + body.model_dump_json().encode()

    async def _follow(self, current: ServedModel | None) -> None:
        """Take the version that is current; None: it has been dropped from memory, maybe for a newer one. Raise
        NotFoundError where the version, the alias or the model has been deleted."""
        self._carry()
        if current is None:
            meant = self._loaded.newest(self._name, self._alias) if self._pin is None else self._pin
            if meant == self._served.version and not self._loaded.is_deleted(self._name, meant):
                return  # it is held here
            current = await to_thread.run_sync(self._loaded.get, self._name, self._pin, self._alias)
        known = self._served.version
        self._take(current)
        if current.version != known:
            await self.greet()

    def _take(self, served: ServedModel) -> None:
        self._served, self._loads, self._noise_std = served, served.payloads, np.array(served.noise_std)
        self._carry()
        limits = served.model.position_limits(self.settings.max_position)
        self._reader = FrameReader(served.model.joint_names, limits)

    def _carry(self) -> None:
        """Answer with what the arm carries, as far as that is known by now."""
        self._carried = self._loads.model_for(self._stream_id)
        model = self._carried or self._served.model
        self._answer = model.answer_fully

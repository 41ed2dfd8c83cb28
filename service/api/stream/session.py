"""Streams of torque queries that can also be learnt from."""

from __future__ import annotations

import json
import logging
from math import nan
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
from anyio import to_thread
from starlette.types import Message, Receive, Send

from lipcore.data.motion import Motion
from lipcore.kernels.drive.play import PlayFollower, element_widths
from lipcore.model import dynamics
from lipcore.model.external import external
from lipcore.vocabulary import offered_components
from service.api.errors import UNEXPECTED_ERROR
from service.api.server.streams import StreamProtocol
from service.api.stream.conversation import Conversation
from service.api.stream.learning import FrameLearning, LearningFrame, StreamLearners
from service.api.stream.parts import answer_part
from service.api.stream.reading import FrameReader
from service.contract import frames
from service.foundation.errors import ErrorBody, ErrorResponse, ServiceError, invalid_request
from service.inference.predicting import check_answer
from service.models.registry import SERVING
from service.models.served import ServedModel
from service.telemetry.meters import StreamMeter

if TYPE_CHECKING:
    from lipcore.data.samples import Array

logger = logging.getLogger(__name__)


class Session(Conversation):
    """Answers every frame with the version that is current at that time, and keeps that version in memory.

    Args:
        connection: The WebSocket connection.
        receive: ASGI's `receive`.
        send: ASGI's `send`.
        learners: The learners of the service.
        served: The first version.
        meter: Counts the answers.
        pinned: Whether to stay with this version.
        std: Whether every answer includes tau_std.
        stream_id: Stream to learn from; None if frames are not learnt.
        alias: Alias to follow; None for the serving version.
        scale: Whether every answer includes the factor on the half width of its intervals.
        payload: Whether every answer includes the mass of the payload.
        rich: Whether answers use all centres of a correction.
        without_gravity: Whether answers contain the torque minus gravity.
    """

    def __init__(
        self,
        connection: StreamProtocol,
        receive: Receive,
        send: Send,
        learners: StreamLearners,
        served: ServedModel,
        meter: StreamMeter,
        pinned: bool,
        std: bool,
        stream_id: str | None = None,
        alias: str | None = None,
        scale: bool = False,
        payload: bool = False,
        rich: bool = False,
        without_gravity: bool = False,
    ) -> None:
        super().__init__(connection, receive, send, learners.settings)
        self._loaded, self._name = learners.loaded, served.name
        self._pin = served.version if pinned else None
        self._alias = None if alias == SERVING else alias
        self._sends_std, self._late = std, 0
        self._sends_scale, self._sends_payload, self._stream_id = scale, payload, stream_id
        self._rich, self._without_gravity = rich, without_gravity
        self._meter, self._deadline = meter, learners.settings.stream_deadline_s
        self._learning = None if stream_id is None else FrameLearning(learners, stream_id, self.send_text)
        self._follower: PlayFollower | None = None  # a session's frames are one motion
        self._use_version(served)

    async def run(self) -> None:
        """Answer frames until either side closes the connection, then log the remaining frames to learn from."""
        try:
            await super().run()
        finally:
            if self._learning is not None:
                await self._learning.close()
                self._learning = None  # no reference cycle, see StreamProtocol

    async def greet(self) -> None:
        """Send the properties of the version, which hold for all its answers."""
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
        """Return the answer frame, or an error frame."""
        sequence, flags = 0, frames.UNREAD
        try:
            data = message.get("bytes")
            if data is None:
                raise invalid_request("frame", "a text message", "a binary message")
            if len(data) < frames.REQUEST.size:
                expected = f"a header of {frames.REQUEST.size} bytes and numbers"
                raise invalid_request("frame", f"{len(data)} bytes long", expected)
            sequence, asked, n, budget = frames.REQUEST.unpack_from(data)
            flags = 0
            current = self._loaded.hot(self._name, self._pin, self._alias)
            if current is not self._served or self._payloads.model_for(self._stream_id) is not self._payload_model:
                await self._update_version(current)
            motion = self._reader.read(data, asked, n, budget)
            if asked >= frames.ASK_GRAVITY:
                model = self._payload_model or self._served.model
                part = await answer_part(self._name, model, asked | self._sends_std, motion)
                return self._finished(sequence, *part, arrived, budget)
            if self._follower is not None:
                self._follower.motion[: len(motion)] = motion
                self._follower.step(arrived)
                motion = self._follower.motion
            if asked & frames.ASK_LEARN:
                await self._admit(sequence, asked)
            compares = asked >= frames.ASK_EXTERNAL
            reduced = np.empty((2, n)) if self._fills_reduced else None
            tau, std, covariance, fallback = self._answer(motion, self._sends_std or asked != 0, compares, reduced)
            check_answer("tau", tau)
            if std is not None:
                check_answer("tau_std", std)
            factor = self._served.scales.of(self._stream_id)
            mean = tau if fallback is None else fallback.mean  # posterior mean for learning and external torque
            if self._without_gravity:
                reduced = await self._reduced(motion, tau - mean) if reduced is None else reduced
                check_answer("tau_without_gravity", reduced)
            more = self._external(data, mean, std, covariance, factor) if compares else b""
        except ServiceError as error:
            return self._refuse(sequence, flags, arrived, error)
        except Exception as error:  # later frames may succeed
            logger.error("unexpected error in a stream of model %s", self._name, exc_info=error)
            return self._refuse(sequence, flags, arrived, ServiceError(UNEXPECTED_ERROR))
        flags, numbers = self._numbers(sequence, asked, arrived, data, tau, std, factor, more, mean)
        if reduced is not None:
            size = (2 if flags & frames.HAS_STD else 1) * tau.nbytes
            numbers = reduced.tobytes()[:size] + numbers[size:]
        if fallback is not None:
            flags |= frames.FALLBACK
        return self._finished(sequence, flags, numbers, arrived, budget)

    def _finished(self, sequence: int, flags: int, numbers: bytes, arrived: float, budget: float) -> bytes:
        """Return the answer frame, and count it."""
        served, n = self._served, self._reader.n_joints
        seconds = perf_counter() - arrived
        self._meter.durations.add(seconds)
        if seconds > (budget or self._deadline):
            self._meter.count_late()
            if budget:
                self._late, flags = self._late + 1, flags | frames.LATE
        return frames.ANSWER.pack(sequence, flags, n, served.version, self._late, served.revision, seconds) + numbers

    async def _admit(self, sequence: int, flags: int) -> None:
        """Wait until there is room for a frame to learn from; raise InvalidRequestError if the stream cannot learn."""
        for name, value in (("version", self._pin), ("alias", self._alias)):
            if value is not None:
                reason = f"only the serving version learns; remove {name} from the address"
                raise invalid_request("flags", flags, f"no flag {frames.ASK_LEARN}: {reason}")
        if self._learning is None:
            expected = f"a name in the address, as in ?stream_id=arm-1, for flag {frames.ASK_LEARN}"
            raise invalid_request("stream_id", "missing", expected)
        await self._learning.admit(sequence)

    async def _reduced(self, motion: Array, more: Array) -> Array:
        """Return the torque minus gravity, and its standard deviation, (2, n), of a model with a nonlinear term.

        more: difference of the torque to send from the posterior mean, (n,).
        """
        model = self._payload_model or self._served.model
        found = await to_thread.run_sync(
            dynamics.components, model, Motion.of(motion[None].copy()), ["without_gravity"]
        )
        estimate = found["without_gravity"]
        return np.stack([estimate.mean[0] + more, estimate.std[0]])

    def _external(self, data: bytes, mean: Array, std: Array | None, covariance: Array | None, factor: Array) -> bytes:
        """Return the bytes of the external torque of a frame; raise InvalidRequestError."""
        assert std is not None  # the flag requests both
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
        """Return flags and numbers of an answer; collect a frame to learn from with its posterior mean."""
        flags, numbers = 0, tau.tobytes()
        if std is not None:
            flags, numbers = frames.HAS_STD, numbers + std.tobytes()
        if asked > frames.ASK_STD:
            if asked & frames.ASK_LEARN:
                assert self._learning is not None  # the frame was admitted
                assert std is not None  # every flag requests it
                posterior = mean.tobytes() + std.tobytes()
                self._learning.add(
                    LearningFrame(
                        self._served, self._payload_model is not None, sequence, arrived, data, posterior, factor
                    )
                )
            if not (asked & frames.ASK_STD or self._sends_std):  # only needed for learning or external torque
                flags, numbers = 0, tau.tobytes()
        if self._sends_scale:
            flags, numbers = flags | frames.HAS_SCALE, numbers + factor.tobytes()
        if external:
            flags, numbers = flags | frames.HAS_EXTERNAL, numbers + external
        if self._sends_payload:
            carried = self._payloads.mass(self._stream_id) or (nan, nan)
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

    async def _update_version(self, current: ServedModel | None) -> None:
        """Switch to the current version; None if it is no longer in memory, perhaps because of a newer one.

        Raise NotFoundError if the version, alias or model has been deleted.
        """
        self._update_payload()
        if current is None:
            meant = self._loaded.newest(self._name, self._alias) if self._pin is None else self._pin
            if meant == self._served.version and not self._loaded.is_deleted(self._name, meant):
                return  # this session keeps it in memory
            current = await to_thread.run_sync(self._loaded.get, self._name, self._pin, self._alias)
        known = self._served.version
        self._use_version(current)
        if current.version != known:
            await self.greet()

    def _use_version(self, served: ServedModel) -> None:
        if self._without_gravity and "without_gravity" not in offered_components(served.model.estimator.name):
            message = f"This model cannot separate gravity: its estimator is {served.model.estimator.name}."
            raise invalid_request("without_gravity", "1", "0, or a model with gravity", message)
        self._served, self._payloads, self._noise_std = served, served.payloads, np.array(served.noise_std)
        self._update_payload()
        if not served.model.remembers:
            self._follower = None
        elif self._follower is None:
            self._follower = PlayFollower(element_widths(served.model.joint_types))
        limits = served.model.position_limits(self.settings.max_position)
        self._reader = FrameReader(served.model.joint_names, limits)

    def _update_payload(self) -> None:
        """Use the model with the currently known payload."""
        self._payload_model = self._payloads.model_for(self._stream_id)
        model = self._payload_model or self._served.model
        self._answer = (model if self._rich else model.fast).answer_fully
        self._fills_reduced = self._without_gravity and model.separates_gravity

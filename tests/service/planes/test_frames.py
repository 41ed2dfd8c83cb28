"""Frames to learn from, between the planes: sent again, refused in time, and never logged after a refusal."""

import asyncio
import time
from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest

from service.foundation.errors import ConflictError, NotReadyError, StorageFullError
from service.foundation.settings import Settings
from service.learning.ingest.frames import Frames, FramesResult
from service.planes import frames
from service.planes.frames import FramesLogged, FramesToLog, RemoteLearners, log_frames

pytestmark = pytest.mark.anyio
RESULT = FramesResult(9, 2, 0, {}, 4)


def some_frames(served=None) -> Frames:
    rows = np.arange(4.0).reshape(2, 2)
    return Frames("m", "arm-1", served, np.array([8, 9]), np.array([1.0, 2.0]), *[rows] * 6)


def version(revision=3):
    return SimpleNamespace(name="m", version=2, revision=revision)


class Channel:
    """The channel to a control plane: keeps messages, and answers each as `answers` says; None: never."""

    def __init__(self, *answers):
        self.sent, self.answers = [], list(answers)
        self.learners = RemoteLearners(Settings(), None, self.send)

    def send(self, message):
        self.sent.append(message)
        answer = self.answers.pop(0) if self.answers else None
        if answer == "gone":
            return False
        if answer == "ends":
            asyncio.get_running_loop().call_soon(self.learners.resend)
        elif answer is not None:
            asyncio.get_running_loop().call_soon(self.learners.receive, FramesLogged(message.number, answer))
        return True

    async def log(self):
        return await self.learners.log_frames("m", lambda: some_frames(version()), time.perf_counter())


async def test_acknowledgement_is_that_of_the_control_plane():
    channel = Channel(RESULT)
    assert await channel.log() == RESULT
    (message,) = channel.sent
    assert (message.version, message.revision, message.frames.served) == (2, 3, None)
    np.testing.assert_array_equal(message.frames.tau, some_frames().tau)


@pytest.mark.parametrize("lost", [("gone",), ("ends",), ("ends", "gone", "gone", "ends")])
async def test_frames_are_sent_again_to_the_next_control_plane(lost):
    channel = Channel(*lost, RESULT)
    assert await channel.log() == RESULT
    assert len(channel.sent) == len(lost) + 1
    assert len({message.number for message in channel.sent}) == 1
    assert len({message.until for message in channel.sent}) == 1


async def test_refusal_of_the_control_plane_is_raised():
    with pytest.raises(ConflictError, match="used otherwise"):
        await Channel(ConflictError("used otherwise")).log()


async def test_silent_control_plane_is_reported_with_what_to_do(monkeypatch):
    monkeypatch.setattr(frames, "MAX_WAIT_S", 0.01)
    channel = Channel()
    with pytest.raises(NotReadyError, match=r"unknown whether these frames are stored.*send them again"):
        await channel.log()
    channel.learners.receive(FramesLogged(channel.sent[0].number, RESULT))  # too late: ignored


async def test_further_frames_wait_less_until_the_control_plane_answers(monkeypatch):
    for name, value in {"MAX_WAIT_S": 0.05, "RESEND_S": 60.0, "monotonic": lambda: 0.0}.items():
        monkeypatch.setattr(frames, name, value)
    channel = Channel("gone", "gone", "gone", RESULT, RESULT)
    for _ in range(5):
        with suppress(NotReadyError):
            await channel.log()
    further = frames.MAX_FURTHER_WAIT_S
    assert [message.until for message in channel.sent] == [0.05, further, further, further, 0.05]


class Log:
    """The learners of the control plane."""

    def __init__(self, error=None):
        self.logged, self.error = [], error
        self.loaded = SimpleNamespace(hot=lambda model, number: None, get=lambda model, number: self.version)

    @property
    def version(self):
        """A version that has learnt since the frames were answered."""
        from dataclasses import make_dataclass

        return make_dataclass("Served", ["name", "version", "revision"])("m", 2, 7)

    async def log_frames(self, model, make, arrived):
        self.logged.append((model, make(), arrived))
        if self.error is not None:
            raise self.error
        return RESULT


def message(until=np.inf):
    return FramesToLog(5, some_frames(), 2, 3, 1.5, until)


async def test_control_plane_logs_frames_with_the_revision_that_answered():
    log = Log()
    assert await log_frames(log, message()) == FramesLogged(5, RESULT)
    ((model, logged, arrived),) = log.logged
    assert (model, logged.served.version, logged.served.revision, arrived) == ("m", 2, 3, 1.5)


async def test_control_plane_logs_nothing_that_was_refused_meanwhile():
    log = Log()
    reply = await log_frames(log, message(until=time.monotonic() - 1e-3))
    assert isinstance(reply.result, NotReadyError)
    assert log.logged == []


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (ConflictError("no"), "conflict"),
        (OSError(28, "full"), StorageFullError.code),
        (KeyError("x"), "internal_error"),
    ],
)
async def test_errors_of_the_log_are_those_of_a_stream_in_one_process(error, code):
    reply = await log_frames(Log(error), message())
    assert reply.result.code == code
    assert "x" not in reply.result.message.split()

"""Frames with torque, without a server: how they are gathered, logged and acknowledged."""

import asyncio
import json
import threading
import time
from time import perf_counter
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pytest
from anyio import to_thread

from service.api.limits.requests import ClientPatience
from service.api.stream.session import Session
from service.foundation.errors import ConflictError, invalid_request
from service.foundation.settings import Settings
from service.learning.ingest.frames import FramesResult
from service.telemetry.meters import Meters
from tests.service.api.stream.test_session import FakeModel, fake_version
from tests.service.data import DEADLINE
from tests.service.streams import ASK_EXTERNAL, ERROR, EXTERNAL, MOTION, STD, TAU, frame, read

QUICK = {"stream_flush_rows": 100, "stream_flush_s": 0.01}
NEVER = 3600.0
pytestmark = pytest.mark.anyio


class FakeLearners:
    """Receives frames in place of the log while `open` is set; raises the given errors first."""

    def __init__(self, *errors):
        self.blocks, self.errors, self.open = [], list(errors), threading.Event()
        self.under_way = self.most_at_once = 0
        self.open.set()

    async def log_frames(self, model, make, arrived):
        """Log frames in a thread."""
        return await to_thread.run_sync(lambda: self.observe_frames(make()))

    def observe_frames(self, frames):
        self.under_way += 1
        self.most_at_once = max(self.most_at_once, self.under_way)
        assert self.open.wait(DEADLINE)
        self.blocks.append(frames)
        self.under_way -= 1
        if self.errors and (error := self.errors.pop(0)) is not None:
            raise error
        return FramesResult(int(frames.sequences[-1]), len(frames.sequences), 0, {}, 7)

    @property
    def sequences(self):
        return [block.sequences.tolist() for block in self.blocks]


class SessionClient:
    """A client of one session, on the other side of ASGI."""

    def __init__(self, learners=None, pinned=False, std=False, stream_id="arm-1", **settings):
        self.learners, self.messages, self.sent = learners or FakeLearners(), asyncio.Queue(), asyncio.Queue()
        self.received, self.aborted = [], asyncio.Event()
        self.passing = {"bytes": asyncio.Event(), "text": asyncio.Event()}
        for passing in self.passing.values():
            passing.set()
        self.current = fake_version(1, FakeModel())
        loaded = SimpleNamespace(hot=lambda name, version, alias: self.current)
        self.learners.settings, self.learners.loaded = Settings(**{**QUICK, **settings}), loaded
        self.connection = SimpleNamespace(arrived=perf_counter(), abort=self.aborted.set, scope={"subprotocols": []})
        client = self.connection, self.messages.get, self.send
        self.session = Session(*client, self.learners, self.current, Meters().stream("m"), pinned, std, stream_id)

    async def __aenter__(self):
        self.messages.put_nowait({"type": "websocket.connect"})
        self.task = asyncio.create_task(self.session.run())
        assert (await self.next())["type"] == "websocket.accept"
        assert "layout" in await self.text()
        return self

    async def __aexit__(self, kind, *_):
        self.messages.put_nowait({"type": "websocket.disconnect", "code": 1000})
        if kind is None:
            await asyncio.wait_for(self.task, DEADLINE)

    async def send(self, message):
        for kind, passing in self.passing.items():
            if kind in message:
                await passing.wait()
        self.sent.put_nowait(message)

    async def next(self):
        self.received.append(await asyncio.wait_for(self.sent.get(), DEADLINE))
        return self.received[-1]

    async def text(self):
        return json.loads((await self.next())["text"])

    async def read_through(self):
        """Return the last sequence of the next acknowledgement."""
        return (await self.text())["learnt"]["through"]

    async def answers(self, *frames):
        """Send frames; return their answers."""
        self.put(*frames)
        return [read((await self.next())["bytes"]) for _ in frames]

    def put(self, *frames):
        for each in frames:
            self.messages.put_nowait({"type": "websocket.receive", "bytes": each})

    async def send_torques(self, *sequences):
        """Send frames with torque; return their answers."""
        return await self.answers(*[frame(sequence=sequence, tau=TAU) for sequence in sequences])

    async def run_pending(self):
        """Let all runnable tasks run."""
        for _ in range(1000):
            await asyncio.sleep(0)


@pytest.mark.parametrize(("flags", "always", "answered"), [(0, False, False), (STD, False, True), (0, True, True)])
async def test_frame_with_torque_is_answered_as_usual_and_learnt(flags, always, answered):
    began = time.time()
    async with SessionClient(std=always) as client:
        client.current = fake_version(1, FakeModel(3.0), revision=4)
        (answer,) = await client.answers(frame([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]], 9, flags, tau=[7.0, 8.0]))
        assert (answer.sequence, answer.revision, answer.tau.tolist()) == (9, 4, [3.0, 6.0])
        assert (answer.std.tolist() == [3.0, 3.0]) if answered else (answer.std is None)
        learnt = {"through": 9, "accepted": 1, "duplicates": 0, "rejected": {}, "revision": 7}
        assert await client.text() == {"learnt": learnt}
        (block,) = client.learners.blocks
        assert (block.model, block.stream_id, block.served) == ("m", "arm-1", client.current)
        assert block.sequences.tolist() == [9]
        assert began - 1.0 < block.time[0] < time.time() + 1.0
        for name, expected in {"q": [1, 2], "dq": [3, 4], "ddq": [5, 6], "tau": [7, 8], "mean": [3, 6]}.items():
            np.testing.assert_array_equal(getattr(block, name), [expected])
        np.testing.assert_array_equal(block.std, [[3.0, 3.0]])
        assert all(getattr(block, name).flags.writeable for name in ("q", "dq", "ddq", "tau", "mean", "std"))


async def test_full_block_is_logged_at_once_the_rest_at_end():
    async with SessionClient(stream_flush_rows=3, stream_flush_s=NEVER) as client:
        await client.send_torques(1, 2, 3)
        assert await client.read_through() == 3
        await client.send_torques(5, 8, 13)
        assert await client.read_through() == 13
        await client.send_torques(14, 15)
        await client.run_pending()
        assert client.learners.sequences == [[1, 2, 3], [5, 8, 13]]
    assert client.learners.sequences == [[1, 2, 3], [5, 8, 13], [14, 15]]
    assert client.sent.empty()


async def test_incomplete_block_is_logged_after_a_while():
    async with SessionClient(stream_flush_s=0.01) as client:
        for first in (1, 3):
            await client.send_torques(first, first + 1)
            while await client.read_through() < first + 1:  # on a slow machine the two frames may be logged separately
                pass
    assert np.concatenate(client.learners.sequences).tolist() == [1, 2, 3, 4]


async def test_blocks_are_logged_in_order_and_a_full_backlog_stops_reading(monkeypatch):
    monkeypatch.setattr("service.api.stream.learning.MAX_WAITING_BLOCKS", 10)
    async with SessionClient(stream_flush_rows=2, stream_flush_s=NEVER) as client:
        client.learners.open.clear()
        answered = await client.send_torques(*range(22))
        client.put(*[frame(sequence=number, tau=TAU) for number in range(22, 60)])
        await client.run_pending()
        assert client.sent.empty()  # two are being logged, 20 wait, the others are not read
        client.learners.open.set()
        later = [await client.next() for _ in range(60 - 22 + 30)]
        answered += [read(each["bytes"]) for each in later if "bytes" in each]
        assert [each.sequence for each in answered] == list(range(60))
        texts = [json.loads(each["text"])["learnt"]["through"] for each in later if "text" in each]
        assert texts == list(range(1, 60, 2))
    assert client.learners.sequences == [[number, number + 1] for number in range(0, 60, 2)]
    assert client.learners.most_at_once == 1


async def test_frames_of_one_revision_are_logged_together():
    async with SessionClient(stream_flush_s=NEVER) as client:
        first = client.current
        await client.send_torques(1, 2)
        client.current = second = fake_version(1, FakeModel(2.0), revision=1)
        await client.send_torques(3)
    blocks = client.learners.blocks
    assert [(block.served, len(block.sequences)) for block in blocks] == [(first, 2), (second, 1)]
    np.testing.assert_array_equal(blocks[1].mean, 2.0 * blocks[1].q)


async def test_frames_received_together_get_increasing_times():
    async with SessionClient(stream_flush_rows=2, stream_flush_s=NEVER) as client:
        for first, later in ((1, -9.0), (3, 0.0), (5, 5.0)):
            client.connection.arrived += later
            await client.send_torques(first, first + 1)
            await client.text()
    steps = np.diff(np.concatenate([block.time for block in client.learners.blocks]))
    assert (steps > 0).all()
    np.testing.assert_allclose(steps, [0, 0, 0, 5, 0], atol=1e-3)


async def test_nan_torque_is_answered_and_forwarded():
    async with SessionClient() as client:
        (answer,) = await client.answers(frame(tau=[np.nan, np.inf]))
        assert answer.error is None
    np.testing.assert_array_equal(client.learners.blocks[0].tau, [[np.nan, np.inf]])


async def test_torque_may_be_compared_or_learnt_or_both():
    async with SessionClient() as client:
        only, refused, both = await client.answers(
            frame(flags=ASK_EXTERNAL, tau=TAU, learn=False),  # nothing is learnt from this frame
            frame(flags=ASK_EXTERNAL, tau=[np.nan, 1.0]),  # an error uses no sequence
            frame(flags=ASK_EXTERNAL, tau=TAU),
        )
        assert await client.read_through() == 1
    assert refused.error["message"] == "tau[0] is nan, expected a finite number"
    assert (only.flags, both.flags) == (EXTERNAL, EXTERNAL)
    np.testing.assert_array_equal(only.external, both.external)
    np.testing.assert_allclose(both.external[:2], TAU - MOTION[0])
    (block,) = client.learners.blocks
    np.testing.assert_array_equal([block.tau, block.mean, block.std], [[TAU], [MOTION[0]], [[1.0, 1.0]]])


async def test_sequences_of_frames_with_torque_must_increase():
    async with SessionClient(stream_flush_s=NEVER) as client:
        (failed,) = await client.answers(frame([[np.nan, 0]] * 3, 2**32 - 1, tau=TAU))  # an error uses no sequence
        assert failed.flags == ERROR
        seen = await client.send_torques(3, 3, 2, 4)
        (plain,) = await client.answers(frame(sequence=1))
        assert plain.error is None
        assert [each.error is None for each in seen] == [True, False, False, True]
        assert seen[2].sequence == 2
        assert seen[2].error["message"] == (
            "sequence is 2, expected more than 3, that of the last frame to learn from: count up, or reconnect"
        )
    assert client.learners.sequences == [[3, 4]]


async def test_block_that_cannot_be_logged_is_rejected_and_the_next_learnt(caplog):
    errors = ConflictError("learning is held"), invalid_request("tau", 1, "2"), ZeroDivisionError("odd")
    async with SessionClient(FakeLearners(*errors), stream_flush_rows=2, stream_flush_s=NEVER) as client:
        for first in (1, 3, 5, 7):
            await client.send_torques(first, first + 1)
            await client.text()
    held, invalid, odd, learnt = (json.loads(each["text"]) for each in client.received[2:] if "text" in each)
    problem = {"code": "conflict", "message": "learning is held", "detail": []}
    assert held == {"refused": {"first": 1, "through": 2, "error": problem}}
    assert invalid["refused"]["error"]["detail"] == [{"field": "tau", "value": "1", "expected": "2"}]
    assert odd["refused"]["error"]["code"] == "internal_error"
    assert (odd["refused"]["first"], odd["refused"]["through"]) == (5, 6)
    assert learnt["learnt"]["through"] == 8
    assert "ZeroDivisionError" in caplog.text


async def test_frames_lost_at_the_end_are_in_the_service_log(caplog):
    async with SessionClient(FakeLearners(ConflictError("learning is held")), stream_flush_s=NEVER) as client:
        await client.send_torques(6, 7)
    assert client.sent.empty()
    assert "frames 6 to 7 of stream 'arm-1' were not learnt: learning is held" in caplog.text


async def test_acknowledgement_waits_for_the_answer_being_written():
    async with SessionClient(stream_flush_rows=1) as client:
        client.passing["bytes"].clear()
        client.put(frame(sequence=1, tau=TAU))
        async with asyncio.timeout(DEADLINE):
            while not client.session._texts:
                await asyncio.sleep(0)
        assert client.sent.empty()
        client.passing["bytes"].set()
        assert "bytes" in await client.next()
        assert await client.read_through() == 1


async def test_client_that_reads_no_acknowledgements_is_disconnected():
    with patch("service.api.stream.conversation.PATIENCE", ClientPatience(frame_s=0.01)):
        async with SessionClient(stream_flush_rows=1) as client:
            client.learners.open.clear()
            await client.send_torques(1)
            client.passing["text"].clear()
            client.learners.open.set()
            await asyncio.wait_for(client.aborted.wait(), DEADLINE)


async def test_frames_of_a_disconnected_client_are_logged():
    async with SessionClient(stream_flush_rows=2, stream_flush_s=NEVER) as client:
        client.learners.open.clear()
        await client.send_torques(1, 2, 3)
        client.messages.put_nowait({"type": "websocket.disconnect", "code": 1006})
        await client.run_pending()
        assert not client.task.done()
        client.learners.open.set()
        await asyncio.wait_for(asyncio.shield(client.task), DEADLINE)
        assert client.session._learning is None
    assert client.learners.sequences == [[1, 2], [3]]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stream_id": None}, "stream_id is missing, expected a name in the address"),
        ({"pinned": True}, "flags is 3"),
    ],
)
async def test_read_only_streams_reject_torque(options, message):
    async with SessionClient(**options) as client:
        (refused,) = await client.send_torques(1)
        assert message in refused.error["message"]
    assert client.learners.blocks == []

"""Frames with torque, without a server: what is gathered, when and how it is logged, and what is said of it."""

import asyncio
import json
import threading
import time
from functools import wraps
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
from tests.service.data import DEADLINE
from tests.service.streams import ASK_EXTERNAL, ERROR, EXTERNAL, MOTION, STD, TAU, frame, read
from tests.service.test_stream_session import Model, served

QUICK = {"stream_flush_rows": 100, "stream_flush_s": 0.01}
NEVER = 3600.0


class Learners:
    """Takes frames in place of the log, while `open` is set; fails with the errors it was given first."""

    def __init__(self, *errors):
        self.blocks, self.errors, self.open = [], list(errors), threading.Event()
        self.under_way = self.most_at_once = 0
        self.open.set()

    @property
    def threads(self):
        """Runs what the session hands over in a thread."""
        return SimpleNamespace(run=lambda _, work, arrived: to_thread.run_sync(work))

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


class Talk:
    """One connection to a session, from the client's side of ASGI."""

    def __init__(self, learners=None, pinned=False, std=False, stream_id="arm-1", **settings):
        self.learners, self.messages, self.sent = learners or Learners(), asyncio.Queue(), asyncio.Queue()
        self.received, self.aborted = [], asyncio.Event()
        self.passing = {"bytes": asyncio.Event(), "text": asyncio.Event()}
        for passing in self.passing.values():
            passing.set()
        self.current = served(1, Model())
        loaded = SimpleNamespace(hot=lambda name, version, alias: self.current)
        self.learners.settings, self.learners.loaded = Settings(**{**QUICK, **settings}), loaded
        self.connection = SimpleNamespace(arrived=perf_counter(), abort=self.aborted.set, scope={"subprotocols": []})
        client = self.connection, self.messages.get, self.send
        meter = Meters().stream("m")
        self.session = Session(*client, self.learners, self.current, meter, pinned, std, stream_id)

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

    async def through(self):
        """The last sequence of the acknowledgement that comes next."""
        return (await self.text())["learnt"]["through"]

    async def answer(self):
        return read((await self.next())["bytes"])

    def put(self, *frames):
        for each in frames:
            self.messages.put_nowait({"type": "websocket.receive", "bytes": each})

    async def teach(self, *sequences, **options):
        """Send frames with torque and read their answers."""
        self.put(*[frame(sequence=sequence, tau=TAU, **options) for sequence in sequences])
        return [await self.answer() for _ in sequences]

    async def settle(self):
        """Let everything run that can run."""
        for _ in range(1000):
            await asyncio.sleep(0)


def played(scene):
    """Run an asynchronous test."""

    @wraps(scene)
    def run(*arguments, **more):
        asyncio.run(asyncio.wait_for(scene(*arguments, **more), 2 * DEADLINE))

    return run


@pytest.mark.parametrize(("flags", "always", "answered"), [(0, False, False), (STD, False, True), (0, True, True)])
@played
async def test_a_frame_with_torque_is_answered_as_without_and_then_learnt(flags, always, answered):
    began = time.time()
    async with Talk(std=always) as talk:
        talk.current = served(1, Model(3.0), revision=4)
        talk.put(frame([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]], 9, flags, tau=[7.0, 8.0]))
        answer = await talk.answer()
        assert (answer.sequence, answer.revision, answer.tau.tolist()) == (9, 4, [3.0, 6.0])
        assert (answer.std.tolist() == [3.0, 3.0]) if answered else (answer.std is None)
        learnt = {"through": 9, "accepted": 1, "duplicates": 0, "rejected": {}, "revision": 7}
        assert await talk.text() == {"learnt": learnt}
        (block,) = talk.learners.blocks
        assert (block.model, block.stream_id, block.served) == ("m", "arm-1", talk.current)
        assert block.sequences.tolist() == [9]
        assert began - 1.0 < block.time[0] < time.time() + 1.0
        for name, expected in {"q": [1, 2], "dq": [3, 4], "ddq": [5, 6], "tau": [7, 8], "mean": [3, 6]}.items():
            np.testing.assert_array_equal(getattr(block, name), [expected])
        np.testing.assert_array_equal(block.std, [[3.0, 3.0]])
        assert all(getattr(block, name).flags.writeable for name in ("q", "dq", "ddq", "tau", "mean", "std"))


@played
async def test_so_many_frames_are_logged_together_and_the_last_at_the_end_untold():
    async with Talk(stream_flush_rows=3, stream_flush_s=NEVER) as talk:
        await talk.teach(1, 2, 3)
        assert await talk.through() == 3
        await talk.teach(5, 8, 13)
        assert await talk.through() == 13
        await talk.teach(14, 15)
        await talk.settle()
        assert talk.learners.sequences == [[1, 2, 3], [5, 8, 13]]
    assert talk.learners.sequences == [[1, 2, 3], [5, 8, 13], [14, 15]]
    assert talk.sent.empty()


@played
async def test_a_few_frames_are_logged_after_a_while():
    async with Talk(stream_flush_s=0.01) as talk:
        for first in (1, 3):
            await talk.teach(first, first + 1)
            while await talk.through() < first + 1:  # on a slow machine the two may be logged one by one
                pass
    assert np.concatenate(talk.learners.sequences).tolist() == [1, 2, 3, 4]


@played
async def test_blocks_are_logged_one_by_one_in_order_and_a_full_backlog_stops_the_reading():
    async with Talk(stream_flush_rows=2, stream_flush_s=NEVER) as talk:
        talk.learners.open.clear()
        talk.put(*[frame(sequence=number, tau=TAU) for number in range(60)])
        answered = [await talk.answer() for _ in range(22)]
        await talk.settle()
        assert talk.sent.empty()  # 2 are being logged, 20 wait, the others are not read
        talk.learners.open.set()
        texts = []
        while len(answered) < 60 or len(texts) < 30:
            message = await talk.next()
            if "bytes" in message:
                answered.append(read(message["bytes"]))
            else:
                texts.append(json.loads(message["text"])["learnt"]["through"])
        assert [each.sequence for each in answered] == list(range(60))
        assert texts == list(range(1, 60, 2))
    assert talk.learners.sequences == [[number, number + 1] for number in range(0, 60, 2)]
    assert talk.learners.most_at_once == 1


@played
async def test_what_one_revision_answered_is_logged_together():
    async with Talk(stream_flush_s=NEVER) as talk:
        first = talk.current
        await talk.teach(1, 2)
        talk.current = second = served(1, Model(2.0), revision=1)
        await talk.teach(3)
    blocks = talk.learners.blocks
    assert [(block.served, len(block.sequences)) for block in blocks] == [(first, 2), (second, 1)]
    np.testing.assert_array_equal(blocks[1].mean, 2.0 * blocks[1].q)


@played
async def test_frames_that_come_in_one_piece_have_times_one_after_the_other():
    async with Talk(stream_flush_rows=2, stream_flush_s=NEVER) as talk:
        for first, later in ((1, -9.0), (3, 0.0), (5, 5.0)):
            talk.connection.arrived += later
            await talk.teach(first, first + 1)
            await talk.text()
    steps = np.diff(np.concatenate([block.time for block in talk.learners.blocks]))
    assert (steps > 0).all()
    np.testing.assert_allclose(steps, [0, 0, 0, 5, 0], atol=1e-3)


@played
async def test_a_torque_that_is_no_number_is_answered_and_handed_on():
    async with Talk() as talk:
        talk.put(frame(tau=[np.nan, np.inf]))
        assert (await talk.answer()).error is None
    np.testing.assert_array_equal(talk.learners.blocks[0].tau, [[np.nan, np.inf]])


@played
async def test_a_torque_may_be_compared_and_learnt_or_one_of_both():
    async with Talk() as talk:
        talk.put(frame(sequence=1, flags=ASK_EXTERNAL, tau=TAU, learn=False))  # of which nothing is learnt
        talk.put(frame(sequence=1, flags=ASK_EXTERNAL, tau=[np.nan, 1.0]))  # an error takes no sequence
        talk.put(frame(MOTION, 1, ASK_EXTERNAL, tau=TAU))
        only, refused, both = [await talk.answer() for _ in range(3)]
        assert await talk.through() == 1
    assert refused.error["message"] == "tau[0] is nan, expected a finite number"
    assert (only.flags, both.flags) == (EXTERNAL, EXTERNAL)
    np.testing.assert_array_equal(only.external, both.external)
    np.testing.assert_allclose(both.external[:2], TAU - MOTION[0])
    (block,) = talk.learners.blocks
    np.testing.assert_array_equal([block.tau, block.mean, block.std], [[TAU], [MOTION[0]], [[1.0, 1.0]]])


@played
async def test_sequences_must_go_up_among_frames_with_torque():
    async with Talk(stream_flush_s=NEVER) as talk:
        talk.put(frame([[np.nan, 0]] * 3, 2**32 - 1, tau=TAU))  # an error takes no sequence
        assert (await talk.answer()).flags == ERROR
        seen = await talk.teach(3, 3, 2, 4)
        talk.put(frame(sequence=1))
        assert (await talk.answer()).error is None
        assert [each.error is None for each in seen] == [True, False, False, True]
        assert seen[2].sequence == 2
        assert seen[2].error["message"] == (
            "sequence is 2, expected more than 3, the last one to learn from: count up, or connect again to "
            "repeat frames"
        )
    assert talk.learners.sequences == [[3, 4]]


@played
async def test_a_block_that_cannot_be_logged_is_refused_and_the_next_is_learnt(caplog):
    errors = ConflictError("learning is held"), invalid_request("tau", 1, "2"), ZeroDivisionError("odd")
    async with Talk(Learners(*errors), stream_flush_rows=2, stream_flush_s=NEVER) as talk:
        for first in (1, 3, 5, 7):
            await talk.teach(first, first + 1)
            await talk.text()
    held, invalid, odd, learnt = (json.loads(each["text"]) for each in talk.received[2:] if "text" in each)
    problem = {"code": "conflict", "message": "learning is held", "detail": []}
    assert held == {"refused": {"first": 1, "through": 2, "error": problem}}
    assert invalid["refused"]["error"]["detail"] == [{"field": "tau", "value": "1", "expected": "2"}]
    assert odd["refused"]["error"]["code"] == "internal_error"
    assert (odd["refused"]["first"], odd["refused"]["through"]) == (5, 6)
    assert learnt["learnt"]["through"] == 8
    assert "ZeroDivisionError" in caplog.text


@played
async def test_frames_lost_at_the_end_are_in_the_log_of_the_service(caplog):
    async with Talk(Learners(ConflictError("learning is held")), stream_flush_s=NEVER) as talk:
        await talk.teach(6, 7)
    assert talk.sent.empty()
    assert "frames 6 to 7 of stream 'arm-1' are not learnt: learning is held" in caplog.text


@played
async def test_an_acknowledgement_waits_for_the_answer_that_is_being_written():
    async with Talk(stream_flush_rows=1) as talk:
        talk.passing["bytes"].clear()
        talk.put(frame(sequence=1, tau=TAU))
        while not talk.session._texts:
            await asyncio.sleep(0)
        assert talk.sent.empty()
        talk.passing["bytes"].set()
        assert "bytes" in await talk.next()
        assert await talk.through() == 1


@played
async def test_who_does_not_read_acknowledgements_is_cut_off():
    with patch("service.api.stream.session.PATIENCE", ClientPatience(frame_s=0.01)):
        async with Talk(stream_flush_rows=1) as talk:
            talk.learners.open.clear()
            await talk.teach(1)
            talk.passing["text"].clear()
            talk.learners.open.set()
            await asyncio.wait_for(talk.aborted.wait(), DEADLINE)


@played
async def test_a_client_that_is_gone_is_told_nothing_and_logged_all_the_same():
    async with Talk(stream_flush_rows=2, stream_flush_s=NEVER) as talk:
        talk.learners.open.clear()
        await talk.teach(1, 2, 3)
        talk.messages.put_nowait({"type": "websocket.disconnect", "code": 1006})
        await talk.settle()
        assert not talk.task.done()
        talk.learners.open.set()
        await asyncio.wait_for(asyncio.shield(talk.task), DEADLINE)
        assert talk.session._learning is None
    assert talk.learners.sequences == [[1, 2], [3]]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stream_id": None}, "stream_id is missing, expected a name of the torque's source"),
        ({"pinned": True}, "flags is 3"),
    ],
)
@played
async def test_streams_that_only_ask_refuse_torque(options, message):
    async with Talk(**options) as talk:
        (refused,) = await talk.teach(1)
        assert message in refused.error["message"]
    assert talk.learners.blocks == []

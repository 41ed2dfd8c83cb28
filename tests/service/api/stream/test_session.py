"""A stream session without a server: its dependence on time, on loaded versions, and on other sessions."""

import asyncio
from time import perf_counter
from types import SimpleNamespace
from unittest.mock import AsyncMock

import numpy as np
import pytest

from lipcore.model.prediction import Fallback, TorqueAnswer
from service.api.errors import UNEXPECTED_ERROR
from service.api.stream.conversation import Echo
from service.api.stream.session import Session
from service.foundation.settings import Settings
from service.models.loads import StreamPayload, StreamPayloads
from service.models.scales import Factor, Scales
from service.telemetry.meters import Meters
from tests.lipcore.remembering import remembering_model, remembering_samples
from tests.service.data import DEADLINE
from tests.service.streams import ASK_EXTERNAL, ERROR, EXTERNAL, FALLBACK, SCALE, STD, frame, read


class FakeModel:
    """A model whose torque is q times a factor and whose standard deviation is the factor."""

    joint_names, torque_convention, remembers = ("a", "b"), "gravity_included", False

    def __init__(self, factor=1.0, fast=None):
        self.factor, self.fast = factor, self if fast is None else fast

    def position_limits(self, largest):
        return np.full(len(self.joint_names), largest)

    def answer(self, motion, std=True):
        return self.factor * motion[0], np.full_like(motion[0], self.factor) if std else None

    def answer_fully(self, motion, std=True, covariance=False, reduced=None):
        covariance_or_none = self.factor**2 * (0.5 + 0.5 * np.eye(motion.shape[1])) if covariance else None
        return TorqueAnswer(*self.answer(motion, std), covariance_or_none, None)


class FakeVersions:
    """Versions in memory and on disk."""

    def __init__(self, **stored):
        self.stored = {int(name[1:]): fake_version(int(name[1:]), model) for name, model in stored.items()}
        self.memory, self.latest, self.loads = dict(self.stored), max(self.stored), 0

    def hot(self, name, version, alias):
        return self.memory.get(self.latest if version is None else version)

    def newest(self, name, alias):
        return self.latest

    def is_deleted(self, name, version):
        return False

    def get(self, name, version, alias):
        self.loads += 1
        return self.memory.setdefault(self.latest, self.stored[self.latest])


def fake_version(version, model, revision=0):
    return SimpleNamespace(
        name="m",
        version=version,
        revision=revision,
        model=model,
        noise_std=[0.1, 0.2],
        scales=Scales(np.ones(2)),
        payloads=StreamPayloads(),
    )


def fake_connection():
    """Return the parts of a connection that a session uses."""
    return SimpleNamespace(arrived=0.0, scope={"subprotocols": []})


def make_session(loaded, version, pinned=False, **more):
    """Return a session and the list of texts that it sends."""
    texts = []

    async def send(message):
        texts.append(message["text"])

    updates = SimpleNamespace(settings=Settings(), loaded=loaded)
    meter = Meters().stream("m")
    return Session(None, None, send, updates, loaded.stored[version], meter, pinned, std=False, **more), texts


def answer_frame(stream_session, request=None, arrived=None):
    request = frame([[1.0, 2.0], [0, 0], [0, 0]]) if request is None else request
    message = {"type": "websocket.receive", "bytes": request}
    return read(asyncio.run(stream_session.reply(message, perf_counter() if arrived is None else arrived)))


@pytest.mark.parametrize(
    ("versions", "pinned", "version", "tau"),
    [
        pytest.param({"v1": FakeModel()}, False, 1, [1.0, 2.0], id="the only version still serves"),
        pytest.param({"v1": FakeModel(), "v2": FakeModel(3.0)}, False, 2, [3.0, 6.0], id="a newer one is loaded"),
        pytest.param({"v1": FakeModel(), "v2": FakeModel(3.0)}, True, 1, [1.0, 2.0], id="a pinned one is kept"),
    ],
)
def test_versions_dropped_from_memory_serve_their_streams(versions, pinned, version, tau):
    loaded = FakeVersions(**versions)
    stream_session, texts = make_session(loaded, 1, pinned=pinned)
    assert not pinned or answer_frame(stream_session).version == 1
    loaded.memory.clear()
    result = answer_frame(stream_session)
    assert (result.version, result.tau.tolist(), loaded.loads, len(texts)) == (version, tau, version - 1, version - 1)
    assert '"version": 2' in "".join(texts) or version == 1


@pytest.mark.parametrize(("rich", "tau"), [(False, [2.0, 4.0]), (True, [1.0, 2.0])])
def test_answers_are_fast_unless_asked_to_be_rich(rich, tau):
    stream_session, _ = make_session(FakeVersions(v1=FakeModel(fast=FakeModel(2.0))), 1, rich=rich)
    assert answer_frame(stream_session).tau.tolist() == tau


def test_frames_of_a_session_are_one_motion():
    """Friction remembers where a joint came from, across versions, until the client is silent."""
    model, samples = remembering_model(), remembering_samples(seed=8, size=200)
    loaded, expected = FakeVersions(v1=model, v2=model), model.predict_along(samples)
    alone = model.predict(samples.q, samples.dq, samples.ddq)
    last = int(np.abs(alone.tau - expected.tau).max(axis=1).argmax())
    assert np.abs(alone.tau[last] - expected.tau[last]).max() > 0.1
    stream_session, _ = make_session(loaded, 1)
    motions = samples.motion().arrays()[:, :3]
    for row in range(last + 1):
        loaded.latest = 1 if row < last // 2 else 2
        answer = answer_frame(stream_session, frame(motions[row]), samples.t[row])
        np.testing.assert_allclose((answer.tau, answer.std), (expected.tau[row], expected.tau_std[row]), rtol=1e-9)
    for another, arrived in ((stream_session, samples.t[last] + 1.0), (make_session(loaded, 1)[0], samples.t[last])):
        answer = answer_frame(another, frame(motions[last]), arrived)
        np.testing.assert_allclose((answer.tau, answer.std), (alone.tau[last], alone.tau_std[last]), rtol=1e-9)


def test_answer_includes_the_current_scale_of_its_stream():
    loaded = FakeVersions(v1=FakeModel())
    stream_session, _ = make_session(loaded, 1, stream_id="arm", scale=True)
    asking, _ = make_session(loaded, 1, scale=True)
    assert answer_frame(stream_session).scale.tolist() == [1.0, 1.0]
    factors = {
        "arm": Factor(np.array([0.5, 3.0]), np.array([0.5, 3.0]), 100.0),
        "other": Factor(np.array([9.0, 2.0]), np.array([0.7, 2.0]), 101.0),
    }
    loaded.memory[1].scales.replace(factors)
    seen = answer_frame(stream_session)
    assert (seen.tau.tolist(), seen.scale.tolist()) == ([1.0, 2.0], [0.5, 3.0])
    assert answer_frame(asking).scale.tolist() == [1.0, 3.0]
    factors["other"] = Factor(np.array([0.7, 2.0]), np.array([0.7, 2.0]), 200.0)  # the first scale is outdated by then
    loaded.memory[1].scales.replace(factors)
    assert answer_frame(asking).scale.tolist() == [1.0, 2.0]
    assert answer_frame(stream_session).scale.tolist() == [0.5, 3.0]


def test_external_torque_is_judged_by_the_scale_of_its_stream():
    loaded = FakeVersions(v1=FakeModel(2.0))
    loaded.memory[1].scales.replace({"arm": Factor(np.array([0.5, 3.0]), np.array([0.5, 3.0]), 100.0)})
    request = frame([[1.0, 2.0], [0, 0], [0, 0]], flags=ASK_EXTERNAL, tau=[3.0, 1.0], learn=False)
    for options, scale in (({"stream_id": "arm"}, [0.5, 3.0]), ({}, [1.0, 3.0]), ({"stream_id": "new"}, [1.0, 1.0])):
        stream_session, _ = make_session(loaded, 1, scale=True, **options)
        seen = answer_frame(stream_session, request)
        assert (seen.flags, seen.tau.tolist(), seen.scale.tolist()) == (SCALE | EXTERNAL, [2.0, 4.0], scale)
        error, std, z = seen.external[:-2].reshape(3, 2)
        np.testing.assert_allclose(error, [1.0, -3.0])
        np.testing.assert_allclose(std, scale * np.sqrt(4.0 + np.array([0.1, 0.2]) ** 2))
        np.testing.assert_allclose(z, error / std)
        function = np.array([[4.01, 2.0], [2.0, 4.04]])
        statistic = (error / scale) @ np.linalg.solve(function, error / scale)
        np.testing.assert_allclose(seen.external[-2:], [statistic, np.exp(-0.5 * statistic)])


def test_new_revision_needs_no_new_hello():
    loaded = FakeVersions(v1=FakeModel())
    stream_session, texts = make_session(loaded, 1)
    loaded.memory[1] = fake_version(1, FakeModel(2.0), revision=2**40)
    result = answer_frame(stream_session)
    assert (result.version, result.revision, result.tau.tolist(), texts) == (1, 2**40, [2.0, 4.0], [])


def test_version_of_another_robot_announces_its_joints():
    other = FakeModel()
    other.joint_names = ("a", "b", "c")
    loaded = FakeVersions(v1=FakeModel(), v2=other)
    stream_session, texts = make_session(loaded, 1)
    assert answer_frame(stream_session).error["message"] == "n is 2, expected 3 joints: a, b, c"
    assert '"joint_names": ["a", "b", "c"]' in texts[0]
    assert answer_frame(stream_session, frame(np.ones((3, 3)))).tau.tolist() == [1.0, 1.0, 1.0]


def test_unexpected_error_is_logged_and_the_stream_continues(caplog):
    stream_session, _ = make_session(FakeVersions(v1=FakeModel()), 1)
    stream_session._answer = lambda *_: 1 / 0
    failed = answer_frame(stream_session)
    assert failed.flags == ERROR
    assert failed.error == {"code": "internal_error", "message": UNEXPECTED_ERROR, "detail": []}
    assert "ZeroDivisionError" in caplog.text
    stream_session._answer = FakeModel().answer_fully
    assert answer_frame(stream_session).tau.tolist() == [1.0, 2.0]


def test_frame_buffer_is_not_shared_with_later_answers():
    stream_session, _ = make_session(FakeVersions(v1=FakeModel()), 1)
    stream_session._answer = lambda motion, *_: (motion[0], None, None, None)  # a view of the buffer
    first = asyncio.run(stream_session.reply({"bytes": frame([[1.0, 1.0], [0, 0], [0, 0]])}, 0.0))
    answer_frame(stream_session)
    assert read(first).tau.tolist() == [1.0, 1.0]


def test_fallback_frame_is_flagged_and_learnt_with_the_posterior_mean():
    stream_session, _ = make_session(FakeVersions(v1=FakeModel()), 1)
    mean, gathered = np.array([7.0, -3.0]), []
    answer = TorqueAnswer(np.ones(2), np.full(2, 0.5), None, Fallback(np.array([0.0, 1.0]), mean))
    stream_session._answer = lambda *_: answer
    stream_session._learning = SimpleNamespace(admit=AsyncMock(), add=gathered.append)
    found = answer_frame(stream_session, frame(flags=STD, tau=[1.0, 1.0]))
    assert (found.flags, found.tau.tolist(), found.std.tolist()) == (STD | FALLBACK, [1.0, 1.0], [0.5, 0.5])
    assert np.frombuffer(gathered[0].answer).tolist() == [7.0, -3.0, 0.5, 0.5]


def test_idle_stream_is_closed():
    messages, texts = asyncio.Queue(), []

    async def send(message):
        texts.append(message)
        if message["type"] == "websocket.close":
            messages.put_nowait({"type": "websocket.disconnect", "code": message["code"]})

    messages.put_nowait({"type": "websocket.connect"})
    echo = Echo(fake_connection(), messages.get, send, Settings(stream_idle_s=0.01))
    asyncio.run(asyncio.wait_for(echo.run(), DEADLINE))
    assert texts == [
        {"type": "websocket.accept", "subprotocol": None},
        {"type": "websocket.close", "code": 1000, "reason": "no frame for 0.01 s (LIPSERVE_STREAM_IDLE_S)"},
    ]


def test_queued_frames_let_other_tasks_run():
    turns = []
    messages = [{"type": "websocket.connect"}]
    messages += [{"type": "websocket.receive", "bytes": bytes([number])} for number in range(5)]
    messages += [{"type": "websocket.disconnect", "code": 1000}]
    receive = AsyncMock(side_effect=messages)

    async def send(message):
        if message["type"] == "websocket.send":
            turns.append(message["bytes"][0])

    async def other():
        for _ in range(5):
            turns.append("other")
            await asyncio.sleep(0)

    async def both():
        await asyncio.gather(Echo(fake_connection(), receive, send, Settings()).run(), other())

    asyncio.run(both())
    assert turns == [0, "other", 1, "other", 2, "other", 3, "other", 4, "other"]


def test_stream_answers_include_its_payload_until_it_is_removed():
    loaded = FakeVersions(v1=FakeModel())
    stream_session, _ = make_session(loaded, 1, stream_id="arm", payload=True)
    payloads, answers = loaded.stored[1].payloads, [answer_frame(stream_session)]
    payloads.replace(
        {"arm": StreamPayload(FakeModel(3.0), (1.5, 0.1), 0.0), "other": StreamPayload(FakeModel(9.0), (7.0, 0.1), 0.0)}
    )
    answers.append(answer_frame(stream_session))
    payloads.replace({"arm": StreamPayload(None, None, 0.0)})
    answers.append(answer_frame(stream_session))
    first = answers[0].tau
    np.testing.assert_allclose([each.tau for each in answers], [first, 3 * first, first])
    np.testing.assert_allclose([each.payload for each in answers], [[np.nan] * 2, [1.5, 0.1], [np.nan] * 2])

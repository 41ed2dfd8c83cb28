"""A stream without a server: what depends on time, on what is in memory, and on who else waits."""

import asyncio
from time import perf_counter
from types import SimpleNamespace

import numpy as np

from lipcore.model.torque_model import Fallback, TorqueAnswer
from service.api.stream.session import Echo, Session
from service.foundation.settings import Settings
from service.models.loads import StreamPayload, StreamPayloads
from service.models.scales import Factor, Scales
from service.telemetry.meters import Meters
from tests.service.data import DEADLINE
from tests.service.streams import ASK_EXTERNAL, ERROR, EXTERNAL, FALLBACK, SCALE, STD, frame, read


class Model:
    """A model whose torque is q times a factor, with the factor for a standard deviation."""

    joint_names, torque_convention = ("a", "b"), "gravity_included"

    def __init__(self, factor=1.0):
        self.factor = factor

    def position_limits(self, largest):
        return np.full(len(self.joint_names), largest)

    def answer(self, motion, std=True):
        return self.factor * motion[0], np.full_like(motion[0], self.factor) if std else None

    def answer_fully(self, motion, std=True, covariance=False):
        covariance_or_none = self.factor**2 * (0.5 + 0.5 * np.eye(motion.shape[1])) if covariance else None
        return TorqueAnswer(*self.answer(motion, std), covariance_or_none, None)


class Loaded:
    """Versions in memory and on disk."""

    def __init__(self, **stored):
        self.stored = {int(name[1:]): served(int(name[1:]), model) for name, model in stored.items()}
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


def served(version, model, revision=0):
    return SimpleNamespace(
        name="m",
        version=version,
        revision=revision,
        model=model,
        noise_std=[0.1, 0.2],
        scales=Scales(np.ones(2)),
        payloads=StreamPayloads(),
    )


def connection():
    """What a conversation asks of its connection."""
    return SimpleNamespace(arrived=0.0, scope={"subprotocols": []})


def session(loaded, version, pinned=False, **more):
    """A session and the texts that it sends."""
    spoken = []

    async def send(message):
        spoken.append(message["text"])

    updates = SimpleNamespace(settings=Settings(), loaded=loaded)
    meter = Meters().stream("m")
    return Session(None, None, send, updates, loaded.stored[version], meter, pinned, std=False, **more), spoken


def reply(talk, request=None, arrived=None):
    request = frame([[1.0, 2.0], [0, 0], [0, 0]]) if request is None else request
    message = {"type": "websocket.receive", "bytes": request}
    return read(asyncio.run(talk.reply(message, perf_counter() if arrived is None else arrived)))


def test_a_version_dropped_from_memory_goes_on_answering_its_stream():
    loaded = Loaded(v1=Model())
    talk, spoken = session(loaded, 1)
    loaded.memory.clear()
    assert reply(talk).tau.tolist() == [1.0, 2.0]
    assert (loaded.loads, spoken) == (0, [])


def test_a_newer_version_is_taken_though_it_is_no_more_in_memory():
    loaded = Loaded(v1=Model(), v2=Model(3.0))
    talk, spoken = session(loaded, 1)
    loaded.memory.clear()
    result = reply(talk)
    assert (result.version, result.tau.tolist(), loaded.loads) == (2, [3.0, 6.0], 1)
    assert '"version": 2' in spoken[0]


def test_an_answer_carries_the_scale_of_its_stream_as_it_is_then():
    loaded = Loaded(v1=Model())
    talk, _ = session(loaded, 1, stream_id="arm", scale=True)
    asking, _ = session(loaded, 1, scale=True)
    assert reply(talk).scale.tolist() == [1.0, 1.0]
    factors = {
        "arm": Factor(np.array([0.5, 3.0]), np.array([0.5, 3.0]), 100.0),
        "other": Factor(np.array([9.0, 2.0]), np.array([0.7, 2.0]), 101.0),
    }
    loaded.memory[1].scales.replace(factors)
    seen = reply(talk)
    assert (seen.tau.tolist(), seen.scale.tolist()) == ([1.0, 2.0], [0.5, 3.0])
    assert reply(asking).scale.tolist() == [1.0, 3.0]
    factors["other"] = Factor(np.array([0.7, 2.0]), np.array([0.7, 2.0]), 200.0)  # by then the first is of long ago
    loaded.memory[1].scales.replace(factors)
    assert reply(asking).scale.tolist() == [1.0, 2.0]
    assert reply(talk).scale.tolist() == [0.5, 3.0]


def test_external_torque_is_judged_by_the_scale_of_its_stream():
    loaded = Loaded(v1=Model(2.0))
    loaded.memory[1].scales.replace({"arm": Factor(np.array([0.5, 3.0]), np.array([0.5, 3.0]), 100.0)})
    request = frame([[1.0, 2.0], [0, 0], [0, 0]], flags=ASK_EXTERNAL, tau=[3.0, 1.0], learn=False)
    for options, scale in (({"stream_id": "arm"}, [0.5, 3.0]), ({}, [1.0, 3.0]), ({"stream_id": "new"}, [1.0, 1.0])):
        talk, _ = session(loaded, 1, scale=True, **options)
        seen = reply(talk, request)
        assert (seen.flags, seen.tau.tolist(), seen.scale.tolist()) == (SCALE | EXTERNAL, [2.0, 4.0], scale)
        error, std, z = seen.external[:-2].reshape(3, 2)
        np.testing.assert_allclose(error, [1.0, -3.0])
        np.testing.assert_allclose(std, scale * np.sqrt(4.0 + np.array([0.1, 0.2]) ** 2))
        np.testing.assert_allclose(z, error / std)
        function = np.array([[4.01, 2.0], [2.0, 4.04]])
        statistic = (error / scale) @ np.linalg.solve(function, error / scale)
        np.testing.assert_allclose(seen.external[-2:], [statistic, np.exp(-0.5 * statistic)])


def test_a_pinned_version_is_kept_whatever_is_newer():
    loaded = Loaded(v1=Model(), v2=Model(3.0))
    talk, spoken = session(loaded, 1, pinned=True)
    assert reply(talk).version == 1
    loaded.memory.clear()
    assert (reply(talk).tau.tolist(), loaded.loads, spoken) == ([1.0, 2.0], 0, [])


def test_a_revision_is_named_without_a_new_hello():
    loaded = Loaded(v1=Model())
    talk, spoken = session(loaded, 1)
    loaded.memory[1] = served(1, Model(2.0), revision=2**40)
    result = reply(talk)
    assert (result.version, result.revision, result.tau.tolist(), spoken) == (1, 2**40, [2.0, 4.0], [])


def test_a_version_of_another_robot_says_how_many_joints_it_has():
    other = Model()
    other.joint_names = ("a", "b", "c")
    loaded = Loaded(v1=Model(), v2=other)
    talk, spoken = session(loaded, 1)
    assert reply(talk).error["message"] == "n is 2, expected 3 joints: a, b, c"
    assert '"joint_names": ["a", "b", "c"]' in spoken[0]
    assert reply(talk, frame(np.ones((3, 3)))).tau.tolist() == [1.0, 1.0, 1.0]


def test_an_unexpected_error_is_answered_logged_and_survived(caplog):
    model = Model()
    talk, _ = session(Loaded(v1=model), 1)
    model.answer = None
    talk._answer = lambda *_: 1 / 0
    failed = reply(talk)
    assert failed.flags == ERROR
    assert failed.error == {
        "code": "internal_error",
        "message": "an unexpected error; the service's log says more",
        "detail": [],
    }
    assert "ZeroDivisionError" in caplog.text
    talk._answer = Model().answer_fully
    assert reply(talk).tau.tolist() == [1.0, 2.0]


def test_the_buffer_of_one_frame_does_not_reach_the_answer_of_another():
    talk, _ = session(Loaded(v1=Model()), 1)
    talk._answer = lambda motion, *_: (motion[0], None, None, None)  # a view of the buffer
    first = asyncio.run(talk.reply({"bytes": frame([[1.0, 1.0], [0, 0], [0, 0]])}, 0.0))
    reply(talk)
    assert read(first).tau.tolist() == [1.0, 1.0]


def test_a_frame_that_falls_back_is_flagged_and_learnt_with_the_mean_of_the_posterior():
    talk, _ = session(Loaded(v1=Model()), 1)
    mean, gathered = np.array([7.0, -3.0]), []
    answer = TorqueAnswer(np.ones(2), np.full(2, 0.5), None, Fallback(np.array([0.0, 1.0]), mean))
    talk._answer = lambda *_: answer

    async def admit(_):
        pass

    talk._learning = SimpleNamespace(admit=admit, add=gathered.append)
    found = reply(talk, frame(flags=STD, tau=[1.0, 1.0]))
    assert (found.flags, found.tau.tolist(), found.std.tolist()) == (STD | FALLBACK, [1.0, 1.0], [0.5, 0.5])
    assert np.frombuffer(gathered[0].answer).tolist() == [7.0, -3.0, 0.5, 0.5]


def test_a_stream_without_frames_is_closed():
    messages, spoken = asyncio.Queue(), []

    async def send(message):
        spoken.append(message)
        if message["type"] == "websocket.close":
            messages.put_nowait({"type": "websocket.disconnect", "code": message["code"]})

    async def idle():
        messages.put_nowait({"type": "websocket.connect"})
        settings = Settings(stream_idle_s=0.01)
        await asyncio.wait_for(Echo(connection(), messages.get, send, settings).run(), DEADLINE)

    asyncio.run(idle())
    assert spoken == [
        {"type": "websocket.accept", "subprotocol": None},
        {"type": "websocket.close", "code": 1000, "reason": "no frame for 0.01 s (LIPSERVE_STREAM_IDLE_S)"},
    ]


def test_others_have_their_turn_between_frames_sent_ahead():
    turns = []
    messages = [{"type": "websocket.connect"}]
    messages += [{"type": "websocket.receive", "bytes": bytes([number])} for number in range(5)]
    messages += [{"type": "websocket.disconnect", "code": 1000}]

    async def receive():
        return messages.pop(0)

    async def send(message):
        if message["type"] == "websocket.send":
            turns.append(message["bytes"][0])

    async def other():
        for _ in range(5):
            turns.append("other")
            await asyncio.sleep(0)

    async def both():
        await asyncio.gather(Echo(connection(), receive, send, Settings()).run(), other())

    asyncio.run(both())
    assert turns == [0, "other", 1, "other", 2, "other", 3, "other", 4, "other"]


def test_a_stream_is_answered_with_what_its_arm_carries_until_it_is_put_down():
    loaded = Loaded(v1=Model())
    talk, _ = session(loaded, 1, stream_id="arm", payload=True)
    payloads, answers = loaded.stored[1].payloads, [reply(talk)]
    payloads.replace(
        {"arm": StreamPayload(Model(3.0), (1.5, 0.1), 0.0), "other": StreamPayload(Model(9.0), (7.0, 0.1), 0.0)}
    )
    answers.append(reply(talk))
    payloads.replace({"arm": StreamPayload(None, None, 0.0)})
    answers.append(reply(talk))
    first = answers[0].tau
    np.testing.assert_allclose([each.tau for each in answers], [first, 3 * first, first])
    np.testing.assert_allclose([each.payload for each in answers], [[np.nan] * 2, [1.5, 0.1], [np.nan] * 2])

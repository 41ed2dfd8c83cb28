"""The controllers' client: of a real service, and of one on a Unix-domain socket that says what a test tells it to."""

import asyncio
import json
import socket
import struct
import threading

import numpy as np
import pytest
from websockets.sync.server import unix_serve

from lipcore.data.motion import Motion
from lipcore.model import dynamics
from lipserve import AsyncStreamClient, StreamClient, StreamError
from lipserve.stream import StreamRefusal
from tests.service.data import DEADLINE
from tests.service.server import free_port
from tests.service.streams import MOTION as PAIR

HELLO = {
    "layout": 1,
    "model": "m",
    "version": 3,
    "revision": 4,
    "joint_names": ["a"],
    "torque_convention": "gravity_included",
    "noise_std": [0.1],
    "max_position": 12.6,
}
MOTION = [0.25], [0.5], [1.0]
CLOSE = object()
"""In a script: the service stops."""


def client_of(streaming, **options):
    return StreamClient("pendulum", streaming.server.url, **{"timeout": DEADLINE, **options})


def answer(sequence):
    """An answer frame of one joint whose torque is its sequence."""
    return struct.pack("<IHHIIQdd", sequence, 0, 1, 3, 0, 4, 0.5, sequence)


def error(sequence):
    body = {"error": {"code": "invalid_request", "message": "no", "detail": []}}
    return struct.pack("<IHHIIQd", sequence, 4, 0, 3, 0, 4, 0.5) + json.dumps(body).encode()


def learnt(through, accepted, duplicates=0, revision=0, **rejected):
    counts = {"through": through, "accepted": accepted, "duplicates": duplicates}
    return json.dumps({"learnt": {**counts, "rejected": rejected, "revision": revision}})


def refused(first, through):
    problem = {"code": "conflict", "message": "held", "detail": []}
    return json.dumps({"refused": {"first": first, "through": through, "error": problem}})


class Scripted:
    """A server on a Unix-domain socket that sends, after each request, what the script says."""

    def __init__(self, path, *script, **hello):
        self.path, self.script, self.requests, self.address = path, list(script), [], ""
        self.hello = json.dumps({**HELLO, **hello})
        self.listening = unix_serve(self.talk, str(path))
        self.thread = threading.Thread(target=self.listening.serve_forever)

    def talk(self, connection):
        self.address = connection.request.path
        connection.send(self.hello)
        for request in connection:
            self.requests.append(request)
            for message in self.script.pop(0):
                if message is CLOSE:
                    connection.close(1001, "the service stops")
                else:
                    connection.send(message)

    def client(self, **options):
        return StreamClient("m", unix=self.path, **{"timeout": DEADLINE, "stream_id": "arm-1", **options})

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.listening.shutdown()
        self.thread.join()


@pytest.fixture
def scripted(tmp_path):
    """Makes a server that follows a script."""
    return lambda *script, **hello: Scripted(tmp_path / "lipserve.sock", *script, **hello)


def test_torque_without_gravity_has_its_own_deviation(streaming):
    motion = Motion(*np.array(PAIR, float)[:, None])
    part = dynamics.components(streaming.model, motion, ["without_gravity"])["without_gravity"]
    whole = streaming.model.posterior.mean(motion)[0]
    with client_of(streaming, without_gravity=True) as client:
        answer = client.predict(*PAIR, tau=whole + 1.0, external=True)
        np.testing.assert_allclose(answer.tau, part.mean[0], rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(answer.tau_std, part.std[0], rtol=1e-5)
        np.testing.assert_allclose(answer.external.tau, 1.0, rtol=1e-6)
        assert np.abs(answer.tau - whole).max() > 1e-3
        bare = client.predict(*PAIR, std=False)
        assert bare.tau_std is None
        np.testing.assert_allclose(bare.tau, part.mean[0], rtol=1e-6, atol=1e-9)


def test_deadlines_are_reported(streaming):
    with client_of(streaming) as client:
        assert client._socket.socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) != 0
        with pytest.raises(StreamError, match=r"no answer within") as missed:  # nor has one come before
            client.predict(*PAIR, deadline=1e-9)
        assert missed.value.code == "timeout"
        seen = [client.predict(*PAIR, deadline=budget) for budget in (60.0, 1e-9, 60.0)]
    # the second is the last answer that came in time
    assert list(map(lateness, seen)) == [(2, False, 1), (2, True, 2), (4, False, 2)]
    assert all(answer.seconds > 0 for answer in seen)

    async def ask():
        async with AsyncStreamClient("pendulum", streaming.server.url, timeout=DEADLINE) as client:
            return [await client.predict(*PAIR, deadline=budget) for budget in (60.0, 1e-9, 60.0)]

    assert list(map(lateness, asyncio.run(ask()))) == [(1, False, 0), (1, True, 1), (3, False, 1)]


def lateness(answer):
    return answer.sequence, answer.late, answer.late_answers


def test_ask_is_a_deprecated_name_of_predict(streaming):
    async def ask():
        async with AsyncStreamClient("pendulum", streaming.server.url, timeout=DEADLINE) as client:
            with pytest.warns(DeprecationWarning, match=r"Use AsyncStreamClient\.predict") as warned:
                return await client.ask(*PAIR, std=False), warned[0].filename

    with client_of(streaming) as client:
        expected = client.predict(*PAIR, std=False)
        with pytest.warns(DeprecationWarning, match=r"Use StreamClient\.predict") as warned:
            answer = client.ask(*PAIR, std=False)
    for found, place in ((answer, warned[0].filename), asyncio.run(ask())):
        np.testing.assert_array_equal(found.tau, expected.tau)
        assert (found.tau_std, place) == (None, __file__)


def test_answer_delayed_on_its_way_is_late(scripted):
    with scripted([answer(1)], [], [answer(2), answer(3)]) as server, server.client() as client:
        seen = [client.predict(*MOTION, deadline=deadline) for deadline in (DEADLINE, 0.01, DEADLINE)]
    assert list(map(lateness, seen)) == [(1, False, 0), (1, True, 1), (3, False, 1)]
    assert [each.tau.tolist() for each in seen[1:]] == [[1.0], [3.0]]


def test_rejected_frame_names_its_field_and_the_next_is_answered(streaming):
    with client_of(streaming) as client:
        with pytest.raises(StreamError, match=r"dq\[1\] is nan, expected a finite number") as refused:
            client.predict(PAIR[0], [0.0, np.nan], PAIR[2])
        assert (refused.value.code, refused.value.sequence) == ("invalid_request", 1)
        assert refused.value.detail == [{"field": "dq[1]", "value": "nan", "expected": "a finite number"}]
        for bad in (([0.0, 0.0], [0.0], [0.0, 0.0]), ([[0.0, 0.0]], [[0.0, 0.0]], [[0.0, 0.0]])):
            with pytest.raises(ValueError, match=r"expected \(n,\) each"):  # before it is sent
                client.predict(*bad)
        assert client.predict(*PAIR).sequence == 2


@pytest.mark.parametrize(
    ("model", "options", "message", "code"),
    [
        ("pendulum", {"version": 2}, "no version '2'", "not_found"),
        ("a b", {}, "no model 'a b'", "not_found"),
        ("a/b", {}, "no stream at /v1/models/a/b/stream", "not_found"),
        ("m", {"url": f"http://127.0.0.1:{free_port()}"}, "no service answers at http://127", "unreachable"),
        ("m", {"unix": "/nobody.sock"}, r"no service answers at .*nobody\.sock", "unreachable"),
    ],
)
def test_stream_that_cannot_be_opened_is_explained(streaming, model, options, message, code):
    with pytest.raises(StreamError, match=message) as refused:
        StreamClient(model, **{"url": streaming.server.url, **options})
    assert refused.value.code == code


def test_reason_of_a_service_that_closes_the_stream_is_reported(scripted):
    with scripted([CLOSE]) as server, server.client() as client:
        for _ in range(2):
            with pytest.raises(StreamError, match="the service closed the stream: the service stops") as gone:
                client.predict(*MOTION)
            assert gone.value.code == "closed"


def test_unknown_layout_is_rejected(scripted):
    with scripted(layout=2) as server, pytest.raises(StreamError, match="layout 2") as refused:
        server.client()
    assert refused.value.code == "layout"


def test_late_answer_is_not_taken_for_the_next(scripted):
    with scripted([], [answer(1), answer(2)]) as server, server.client() as client:
        client.timeout = 0.01
        with pytest.raises(StreamError, match=r"no answer within 0.01 s") as missed:
            client.predict(*MOTION)
        assert missed.value.code == "timeout"
        client.timeout = DEADLINE
        late = client.predict(*MOTION)
    assert (late.sequence, late.tau.tolist(), late.version, late.revision) == (2, [2.0], 3, 4)
    assert len(server.requests) == 2


def test_torque_is_sent_after_the_motion_with_its_flag(scripted):
    with scripted([answer(1)], [answer(2)], [answer(3)]) as server, server.client() as client:
        client.predict(*MOTION, tau=[7.0])
        client.predict(*MOTION, std=False, deadline=0.5, tau=[8.0])
        client.predict(*MOTION)
    assert server.address == "/v1/models/m/stream?stream_id=arm-1"
    assert server.requests == [
        struct.pack("<IHHddddd", 1, 3, 1, 0.0, 0.25, 0.5, 1.0, 7.0),
        struct.pack("<IHHddddd", 2, 2, 1, 0.5, 0.25, 0.5, 1.0, 8.0),
        struct.pack("<IHHdddd", 3, 1, 1, 0.0, 0.25, 0.5, 1.0),
    ]


def test_acknowledgements_add_up(scripted):
    script = (
        [answer(1)],
        [answer(2), learnt(2, 1, 1)],
        [answer(3), learnt(3, 0, contact=1), answer(99)],
        [learnt(5, 0, 1, 9, contact=2, limit=1), answer(4)],
    )
    with scripted(*script) as server, server.client() as client:
        assert (client.learnt.through, client.learnt.accepted) == (0, 0)
        for _ in range(4):
            client.predict(*MOTION, tau=[0.0])
        total = client.flush()
        assert total == client.learnt
        assert (total.through, total.accepted, total.duplicates, total.revision) == (5, 1, 2, 9)
        assert total.rejected == {"contact": 3, "limit": 1}
        assert client.refusals == ()


def test_flush_waits_for_the_last_torque_and_keeps_answers_for_later(scripted):
    script = [], [answer(1), learnt(1, 1)], [error(2)], [answer(3), json.dumps({**HELLO, "version": 5}), refused(3, 3)]
    with scripted(*script) as server, server.client() as client:
        client.flush(0.0)  # nothing is owed
        for _ in range(4):
            client.send(*MOTION, tau=[0.0])
        server.script.append([answer(4), answer(5), learnt(5, 2)])
        client.send(*MOTION, tau=[0.0])
        assert client.flush().through == 5
        assert client.hello.version == 5
        assert client.refusals == (StreamRefusal(3, 3, "conflict", "held", []),)
        assert client.receive().tau == [1.0]
        with pytest.raises(StreamError, match="no") as wrong:
            client.receive()
        assert wrong.value.sequence == 2
        assert [client.receive().sequence for _ in range(3)] == [3, 4, 5]


def test_flush_times_out_and_may_be_called_again(scripted):
    with scripted([answer(1)], [answer(2)], [learnt(2, 2), answer(3)]) as server, server.client() as client:
        client.predict(*MOTION, tau=[0.0])
        client.predict(*MOTION, tau=[0.0])
        with pytest.raises(StreamError, match=r"2 torques were neither acknowledged nor refused within 0.01 s") as late:
            client.flush(0.01)
        assert late.value.code == "timeout"
        client.send(*MOTION)
        assert client.flush().accepted == 2
        assert client.receive().sequence == 3


def test_client_continues_from_the_given_sequence(scripted):
    with scripted([answer(41), learnt(41, 0, 1)]) as server, server.client(first_sequence=41) as client:
        assert client.learnt.through == 40
        assert client.predict(*MOTION, tau=[0.0]).sequence == 41
        assert client.flush().through == 41
        server.script.append([answer(0)])
        with server.client(first_sequence=0) as other:
            assert other.predict(*MOTION).sequence == 0
    for first in (-1, 2**32):
        with pytest.raises(ValueError, match=rf"first_sequence is {first}, expected 0 to 4294967295"):
            StreamClient("m", first_sequence=first)


def test_torque_needs_a_stream_id_and_a_shape(scripted):
    shapes = r"\(1,\), \(1,\), \(1,\), \(2,\), expected \(n,\)"
    with scripted() as server:
        with server.client(stream_id=None) as client, pytest.raises(ValueError, match="`tau` has no effect"):
            client.send(*MOTION, tau=[0.0])
        assert server.address == "/v1/models/m/stream"
        with server.client() as client, pytest.raises(ValueError, match=shapes):
            client.send(*MOTION, tau=[0.0, 1.0])
        with server.client(version=2):
            assert server.address == "/v1/models/m/stream?version=2&stream_id=arm-1"
    assert server.requests == []

"""The controllers' client with torque to learn from, against a server that says what a test tells it to."""

from __future__ import annotations

import json
import socket
import struct
import threading

import pytest
from websockets.sync.server import unix_serve

from service.client.stream import StreamClient, StreamError, StreamRefusal
from tests.service.data import DEADLINE

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


def answer(sequence):
    """An answer frame of one joint whose torque is its sequence."""
    return struct.pack("<IHHIIQdd", sequence, 0, 1, 3, 0, 4, 0.5, sequence)


def error(sequence):
    body = {"error": {"code": "invalid_request", "message": "no", "detail": []}}
    return struct.pack("<IHHIIQd", sequence, 4, 0, 3, 0, 4, 0.5) + json.dumps(body).encode()


def learnt(through, accepted, duplicates=0, revision=0, **rejected):
    return json.dumps(
        {
            "learnt": {
                "through": through,
                "accepted": accepted,
                "duplicates": duplicates,
                "rejected": rejected,
                "revision": revision,
            }
        }
    )


def refused(first, through):
    problem = {"code": "conflict", "message": "held", "detail": []}
    return json.dumps({"refused": {"first": first, "through": through, "error": problem}})


class Scripted:
    """A server on a Unix-domain socket that sends, after each request, what the script says."""

    def __init__(self, path, *script):
        self.path, self.script, self.requests, self.address = path, list(script), [], ""
        self.listening = unix_serve(self.talk, str(path))
        self.thread = threading.Thread(target=self.listening.serve_forever)

    def talk(self, connection):
        self.address = connection.request.path
        connection.send(json.dumps(HELLO))
        for request in connection:
            self.requests.append(request)
            for message in self.script.pop(0):
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
    return lambda *script: Scripted(tmp_path / "lipserve.sock", *script)


def test_torque_goes_out_after_the_motion_with_its_flag(scripted):
    with scripted([answer(1)], [answer(2)], [answer(3)]) as server, server.client() as client:
        client.ask(*MOTION, tau=[7.0])
        client.ask(*MOTION, std=False, deadline=0.5, tau=[8.0])
        client.ask(*MOTION)
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
            client.ask(*MOTION, tau=[0.0])
        found = client.flush()
        assert found == client.learnt
        assert (found.through, found.accepted, found.duplicates, found.revision) == (5, 1, 2, 9)
        assert found.rejected == {"contact": 3, "limit": 1}
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


def test_a_torque_whose_frame_is_an_error_is_not_waited_for(scripted):
    with scripted([error(1)]) as server, server.client() as client:
        client.send(*MOTION, tau=[0.0])
        assert client.flush().through == 0


def test_flush_gives_up_and_may_be_called_again(scripted):
    with scripted([answer(1)], [answer(2)], [learnt(2, 2), answer(3)]) as server, server.client() as client:
        client.ask(*MOTION, tau=[0.0])
        client.ask(*MOTION, tau=[0.0])
        with pytest.raises(StreamError, match=r"2 torques are neither acknowledged nor refused within 0.01 s") as late:
            client.flush(0.01)
        assert late.value.code == "timeout"
        client.send(*MOTION)
        assert client.flush().accepted == 2
        assert client.receive().sequence == 3


def test_flush_says_that_the_service_is_gone(scripted):
    with scripted([answer(1)]) as server:
        client = server.client()
        client.ask(*MOTION, tau=[0.0])
        client._socket.socket.shutdown(socket.SHUT_RDWR)
        with pytest.raises(StreamError) as gone:
            client.flush()
        assert gone.value.code == "closed"


def test_a_client_goes_on_from_the_sequence_it_is_given(scripted):
    with scripted([answer(41), learnt(41, 0, 1)]) as server, server.client(first_sequence=41) as client:
        assert client.learnt.through == 40
        assert client.ask(*MOTION, tau=[0.0]).sequence == 41
        assert client.flush().through == 41
        server.script.append([answer(0)])
        with server.client(first_sequence=0) as other:
            assert other.ask(*MOTION).sequence == 0


@pytest.mark.parametrize("first", [-1, 2**32])
def test_a_first_sequence_that_is_none_is_refused(first):
    with pytest.raises(ValueError, match=rf"first_sequence is {first}, expected 0 to 4294967295"):
        StreamClient("m", first_sequence=first)


def test_torque_needs_a_source_and_a_shape(scripted):
    with scripted() as server:
        with (
            server.client(stream_id=None) as client,
            pytest.raises(ValueError, match="expected a client with stream_id"),
        ):
            client.send(*MOTION, tau=[0.0])
        assert server.address == "/v1/models/m/stream"
        with (
            server.client() as client,
            pytest.raises(ValueError, match=r"\(1,\), \(1,\), \(1,\), \(2,\), expected \(n,\)"),
        ):
            client.send(*MOTION, tau=[0.0, 1.0])
        with server.client(version=2) as client:
            assert server.address == "/v1/models/m/stream?version=2&stream_id=arm-1"
    assert server.requests == []


def test_refusals_are_kept_within_bounds(scripted):
    texts = [refused(number, number) for number in range(1, 1203)]
    with scripted([*texts, answer(1)]) as server, server.client() as client:
        client.ask(*MOTION, tau=[0.0])
        assert [client.refusals[0].first, len(client.refusals)] == [203, 1000]

"""The controllers' client: answers, errors, deadlines, time-outs, and a Unix-domain socket."""

from __future__ import annotations

import socket
import threading

import numpy as np
import pytest
from websockets.sync.server import serve, unix_serve

from service.client.stream import StreamClient, StreamError
from tests.service.data import DEADLINE
from tests.service.server import free_port
from tests.service.streams import MOTION, motions

HELLO = (
    '{"layout": 1, "model": "m", "version": 3, "revision": 4, "joint_names": ["a"], '
    '"torque_convention": "gravity_included", "noise_std": [0.1], "max_position": 12.6}'
)


def client_of(streaming, **options):
    return StreamClient("pendulum", streaming.server.url, **{"timeout": DEADLINE, **options})


def answer(sequence, tau):
    """An answer frame of one joint, without tau_std."""
    return (
        np.array([sequence, 1 << 16, 3, 0], "<u4").tobytes()
        + np.array([4], "<u8").tobytes()
        + np.array([0.5, tau]).tobytes()
    )


class Scripted:
    """A server that sends what a test tells it to, once a request: sequences relative to the request's."""

    def __init__(self, listen, *answers):
        self.requests, self.answers = [], list(answers)
        self.listening = listen(self.talk)
        self.thread = threading.Thread(target=self.listening.serve_forever)

    def talk(self, connection):
        connection.send(HELLO)
        for request in connection:
            self.requests.append(request)
            sequence = int.from_bytes(request[:4], "little")
            for back, tau in self.answers.pop(0):
                connection.send(answer(sequence - back, tau))

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.listening.shutdown()
        self.thread.join()


def test_it_says_what_the_service_says(streaming):
    with client_of(streaming) as client:
        assert client.hello.joint_names == streaming.model.joint_names
        np.testing.assert_allclose(client.hello.noise_std, streaming.model.noise_std, rtol=1e-12)
        for motion in motions(5, seed=6):
            tau, std = streaming.model.answer(motion)
            both, mean = client.ask(*motion), client.ask(*motion.tolist(), std=False)
            np.testing.assert_allclose(both.tau, tau, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(both.tau_std, std, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(mean.tau, tau, rtol=1e-12, atol=1e-12)
            assert mean.tau_std is None
            assert (both.version, both.revision, both.late) == (1, 0, False)


def test_deadlines_are_reported(streaming):
    with client_of(streaming) as client:
        seen = [client.ask(*MOTION, deadline=budget) for budget in (1e-9, 60.0, 1e-9)]
    assert [answer.late for answer in seen] == [True, False, True]
    assert [answer.late_answers for answer in seen] == [1, 1, 2]
    assert all(answer.seconds > 0 for answer in seen)


def test_a_refused_motion_names_the_field_and_the_next_is_answered(streaming):
    with client_of(streaming) as client:
        with pytest.raises(StreamError, match=r"dq\[1\] is nan, expected a finite number") as refused:
            client.ask(MOTION[0], [0.0, np.nan], MOTION[2])
        assert refused.value.code == "invalid_request"
        assert refused.value.detail == [{"field": "dq[1]", "value": "nan", "expected": "a finite number"}]
        assert refused.value.sequence == 1
        assert client.ask(*MOTION).sequence == 2


@pytest.mark.parametrize("bad", [([0.0, 0.0], [0.0], [0.0, 0.0]), ([[0.0, 0.0]], [[0.0, 0.0]], [[0.0, 0.0]])])
def test_shapes_that_make_no_frame_are_refused_before_they_are_sent(streaming, bad):
    with client_of(streaming) as client:
        with pytest.raises(ValueError, match=r"expected \(n,\) each"):
            client.ask(*bad)
        assert client.ask(*MOTION).sequence == 1


def test_a_version_can_be_pinned(streaming):
    with client_of(streaming, version=1) as client:
        assert client.ask(*MOTION).version == 1
    with pytest.raises(StreamError, match="no version '2'") as refused:
        client_of(streaming, version=2)
    assert refused.value.code == "not_found"


def test_an_unknown_model_is_refused_with_the_services_words(streaming):
    with pytest.raises(StreamError, match="no model 'a b'") as refused:
        StreamClient("a b", streaming.server.url)
    assert refused.value.code == "not_found"
    with pytest.raises(StreamError, match="no stream at /v1/models/a/b/stream") as refused:
        StreamClient("a/b", streaming.server.url)
    assert refused.value.code == "not_found"


def test_nobody_listens():
    with pytest.raises(StreamError, match="no service answers at http://127") as failed:
        StreamClient("m", f"http://127.0.0.1:{free_port()}")
    assert failed.value.code == "unreachable"


def test_a_service_that_closes_the_stream_is_quoted():
    def talk(connection):
        connection.send(HELLO)
        connection.recv()
        connection.close(1001, "the service stops")

    with serve(talk, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        client = StreamClient("m", f"http://127.0.0.1:{server.socket.getsockname()[1]}", timeout=DEADLINE)
        for _ in range(2):
            with pytest.raises(StreamError, match="the service closed the stream: the service stops") as gone:
                client.ask([0.0], [0.0], [0.0])
            assert gone.value.code == "closed"
        client.close()
        server.shutdown()
        thread.join()


def test_a_layout_that_the_client_does_not_know_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "lipserve.sock"
    monkeypatch.setattr("tests.service.test_stream_client.HELLO", HELLO.replace('"layout": 1', '"layout": 2'))
    with Scripted(lambda talk: unix_serve(talk, str(path))), pytest.raises(StreamError, match="layout 2") as refused:
        StreamClient("m", unix=path, timeout=DEADLINE)
    assert refused.value.code == "layout"


def test_an_answer_that_comes_too_late_is_not_taken_for_the_next(tmp_path):
    path = tmp_path / "lipserve.sock"
    script = [], [(1, -1.0), (0, 2.0)]
    with Scripted(lambda talk: unix_serve(talk, str(path)), *script) as server, StreamClient("m", unix=path) as client:
        client.timeout = 0.01
        with pytest.raises(StreamError, match=r"no answer within 0.01 s") as missed:
            client.ask([0.0], [0.0], [0.0])
        assert missed.value.code == "timeout"
        client.timeout = DEADLINE
        found = client.ask([0.0], [0.0], [0.0])
    assert (found.sequence, found.tau.tolist(), found.version, found.revision) == (2, [2.0], 3, 4)
    assert len(server.requests) == 2


def test_a_unix_socket_that_is_not_there(tmp_path):
    with pytest.raises(StreamError, match=r"no service answers at .*nobody\.sock") as failed:
        StreamClient("m", unix=tmp_path / "nobody.sock")
    assert failed.value.code == "unreachable"


def test_nagle_is_off(streaming):
    with client_of(streaming) as client:
        assert client._socket.socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) != 0

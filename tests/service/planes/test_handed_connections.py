"""What a connection keeps when it passes between the planes: its client, its limits, its unsent answers."""

import gc
import json
import os
import socket
from contextlib import suppress

import pytest
from websockets.sync.client import connect

from service.api.limits.requests import COUNTED, ClientPatience
from service.api.server.connections import GuardedProtocol
from service.api.server.streams import StreamProtocol
from tests.service.api.limits.serving import RawConnection, Serving
from tests.service.data import DEADLINE, eventually
from tests.service.planes.requests import ECHO, HOST, PAGE, Digest, echo
from tests.service.planes.two_planes import TwoPlanes


class Told:
    """Answers with the client's address, and whether rate limits had counted the request before."""

    async def __call__(self, scope, receive, send):
        content = json.dumps([*(scope["client"] or ()), COUNTED in scope]).encode()
        length = [(b"content-length", b"%d" % len(content))]
        await send({"type": "http.response.start", "status": 200, "headers": length})
        await send({"type": "http.response.body", "body": content})


def told(client: RawConnection, request: bytes) -> list[object]:
    """Return the answer of `Told`."""
    status, content = client.ask(request)
    assert status == 200
    return json.loads(content)


@pytest.fixture
def planes():
    """Two planes at a port."""
    with TwoPlanes(with_app=Digest()) as made:
        yield made


def test_each_plane_answers_its_requests_of_one_connection(planes):
    with planes.connect() as client:
        for number in range(1, 4):
            assert client.ask(echo(b"abc"))[0] == client.ask(PAGE)[0] == 200
            assert (planes.queries.answered, planes.app.begun) == (number, 2 * number)
        assert client.ask(echo(b"later"))[0] == 200
        assert (planes.queries.answered, planes.app.begun) == (3, 7)


def test_only_a_request_that_was_handed_over_by_the_application_was_counted():
    with TwoPlanes(with_app=Told()) as planes, planes.connect() as client:
        asked = [echo(b"later"), PAGE, echo(b"abc"), PAGE, echo(b"later"), echo(b"later")]
        assert [told(client, each)[-1] for each in asked] == [True, False, False, False, True, True]


@pytest.mark.parametrize("family", [socket.AF_INET, socket.AF_INET6])
def test_both_planes_know_the_address_of_the_client(family):
    host = {socket.AF_INET: "127.0.0.1", socket.AF_INET6: "::1"}[family]
    with socket.create_server((host, 0), family=family) as listening:
        listening.listen()
        address = listening.getsockname()
        with TwoPlanes(with_app=Told(), unix=listening), socket.create_connection(address[:2], DEADLINE) as made:
            client = RawConnection.of(made)
            own = list(made.getsockname()[:2])
            asked = [echo(b"abc"), PAGE, PAGE, echo(b"abc"), echo(b"later")]
            assert [told(client, each)[:2] for each in asked] == [own] * len(asked)


def test_trusted_proxy_names_the_client_in_both_planes():
    forwarded = HOST + b"X-Forwarded-For: 192.0.2.7\r\n"
    for trusted, named in (("127.0.0.1", "192.0.2.7"), ("192.0.2.1", "127.0.0.1")):
        with TwoPlanes(with_app=Told(), trusted_proxies=trusted) as planes, planes.connect() as client:
            for request in (echo(b"abc"), PAGE, echo(b"later")):
                assert told(client, request.replace(HOST, forwarded))[0] == named


def test_client_that_expects_to_be_asked_for_its_body_is_asked(planes):
    with planes.connect() as client:
        client.send(ECHO.replace(HOST, HOST + b"Expect: 100-continue\r\n") % (3, b""))
        assert client.read_exactly(25) == b"HTTP/1.1 100 Continue\r\n\r\n"
        assert client.ask(b"abc") == planes.ask(echo(b"abc"))


class Large:
    """Answers with many bytes."""

    content = bytes(range(256)) * 1000

    async def __call__(self, scope, receive, send):
        length = [(b"content-length", b"%d" % len(self.content))]
        await send({"type": "http.response.start", "status": 200, "headers": length})
        await send({"type": "http.response.body", "body": self.content})


def test_answers_that_wait_for_a_slow_reader_are_sent_before_the_connection_leaves():
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)  # an answer does not fit into it
        listening.listen()
        with TwoPlanes(with_app=Large(), unix=listening) as planes, socket.socket() as made:
            made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            made.settimeout(DEADLINE)
            made.connect(listening.getsockname())
            client, asked = RawConnection.of(made), [echo(b"abc"), PAGE, PAGE, echo(b"later"), echo(b"abc"), PAGE]
            for request in asked:
                client.send(request)
            eventually(lambda: planes.queries.answered == 1)
            for _ in asked:
                assert client.read_answer() == (200, Large.content)


def test_rest_of_a_slow_query_is_read_by_the_control_plane():
    query = echo(b"abc")
    with TwoPlanes(with_app=Digest(), patience=ClientPatience(header_s=0.05)) as planes, planes.connect() as client:
        client.send(query[:-1])
        eventually(lambda: len(planes.server.server_state.connections) == 1)
        assert client.ask(query[-1:]) == planes.ask(query)


def test_no_descriptor_is_left_over(planes):
    def turn():
        with planes.connect() as client:
            client.send(PAGE[:-2])  # partly sent
        with planes.connect() as client:
            for request in (echo(b"abc"), PAGE, echo(b"later"), echo(bytes(40_000)), echo(b"abc")):
                assert client.ask(request)[0] == 200
        eventually(lambda: planes.connections == 0)
        return len(os.listdir("/proc/self/fd"))

    before = turn()
    assert max(turn() for _ in range(20)) <= before


def test_queries_are_answered_without_a_control_plane(planes):
    with planes.connect() as client, planes.connect() as other:
        assert other.ask(PAGE)[0] == 200
        planes.accepting.close()  # else what is passed on waits for the next control plane
        planes.planes.close()
        eventually(lambda: planes.link.passed.count(None) == 0)
        for _ in range(3):
            assert client.ask(echo(b"abc"))[0] == 200
        status, code, message = planes.refusal(PAGE)
        assert (status, code) == (503, "not_ready")
        assert "control plane" in message
        assert planes.refusal(echo(b"later"))[:2] == (503, "not_ready")
        with planes.connect(b"GET /v2/models/arm HTTP/1.1\r\n" + HOST + b"\r\n") as third:
            status, body = third.read_answer()
        assert (status, json.loads(body)) == (503, {"error": message})
        assert other.ask(echo(b"abc"))[0] == 200  # by the control plane, which cannot pass it back


@pytest.mark.parametrize("kind", [Serving, TwoPlanes])
@pytest.mark.parametrize("request_bytes", [echo(b"abc"), echo(b"later"), PAGE], ids=["query", "handed over", "page"])
def test_client_that_sends_nothing_more_gets_its_answer(kind, request_bytes):
    with kind(with_app=Digest()) as serving, serving.connect(request_bytes) as client:
        client.socket.shutdown(socket.SHUT_WR)
        assert client.read_answer()[0] == 200
        assert client.read_to_end() == b""


def test_connection_on_its_way_to_a_control_plane_that_ends_is_closed(planes):
    planes.planes.close()
    waiting, _ = planes.accepting.accept()  # the next control plane, which reads nothing
    with planes.connect() as client:
        assert client.ask(echo(b"abc"))[0] == 200
        eventually(lambda: planes.link.is_connected)
        client.send(PAGE)
        eventually(lambda: planes.link.passed.count(None) == 1)
        waiting.close()
        with suppress(ConnectionResetError):
            assert client.socket.recv(1) == b""
        eventually(lambda: planes.link.passed.count(None) == 0)


def test_query_that_waits_for_a_revision_wakes_the_learner(planes):
    planes.link.loaded.wake("arm")
    eventually(lambda: planes.loaded.woken == ["arm"])


def connections_in_memory():
    return sum(issubclass(type(each), (GuardedProtocol, StreamProtocol)) for each in gc.get_objects())


@pytest.mark.parametrize("kind", [Serving, TwoPlanes])
def test_closed_connections_need_no_garbage_collection(kind):
    with kind() as serving:
        gc.collect()
        before = connections_in_memory()
        gc.disable()
        try:
            for request in (echo(b"abc"), PAGE, echo(b"later")):
                with serving.connect() as client:
                    assert [client.ask(request)[0] for _ in range(2)] == [200, 200]
            with connect(f"ws://127.0.0.1:{serving.port}/v1/echo/stream") as stream:
                stream.send(b"abc")
                assert stream.recv(DEADLINE) == b"abc"
            eventually(lambda: connections_in_memory() == before, 10)
        finally:
            gc.enable()

"""Limits of connections: too many, silent, slow, never reading, endless."""

import time
from contextlib import suppress

import pytest
from websockets.sync.client import connect

from service.api.limits.requests import ClientPatience
from service.api.server.connections import MAX_REFUSED_CONNECTIONS, GuardedProtocol
from tests.service.api.limits.serving import RawConnection, Serving, error_of
from tests.service.data import DEADLINE, eventually

MiB = 1024 * 1024
SOON = ClientPatience(header_s=1.0, answer_s=1.0)
"""Limits that are reached quickly."""
GET = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"
LARGE = GET.replace(b"/ ", b"/large ", 1)
POST = b"POST /body HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"


@pytest.fixture(scope="module")
def impatient_server():
    """A server whose limits are reached quickly."""
    with Serving(patience=SOON, keep_alive_s=1) as serving:
        yield serving


@pytest.fixture(scope="module")
def small_server():
    """A patient server for two connections."""
    with Serving(patience=ClientPatience(header_bytes=4096), max_connections=2) as serving:
        yield serving


@pytest.fixture
def none_open(small_server):
    """The same server once nobody is connected and no request is counted as unanswered."""
    eventually(lambda: small_server.connections == 0 and small_server.app.asking == 0)
    return small_server


def occupy(serving, *clients):
    """Start requests that stay unanswered, as the rest of their bodies is still missing."""
    before = serving.app.asking
    for client in clients:
        client.send(POST)
    eventually(lambda: serving.app.asking == before + len(clients))


def test_sequential_requests_are_answered(small_server, none_open):
    with RawConnection(small_server.port) as client:
        for _ in range(2 * 4096 // len(GET)):  # the header limit applies to each request alone
            client.send(GET)
            assert client.read_answer() == (200, b"hello")
        client.send(GET * 3)
        assert [client.read_answer() for _ in range(3)] == [(200, b"hello")] * 3


@pytest.mark.slow
def test_clients_without_a_request_are_disconnected(impatient_server):
    """All wait at the same time, as each takes a second."""
    with (
        RawConnection(impatient_server.port) as silent,
        RawConnection(impatient_server.port) as half,
        RawConnection(impatient_server.port) as second,
        RawConnection(impatient_server.port) as idle,
    ):
        half.send(GET[:-2])
        second.send(GET)
        idle.send(GET)
        assert second.read_answer() == idle.read_answer() == (200, b"hello")
        second.send(GET[:-2])
        status, code, message = error_of(half.read_to_end())
        assert (status, code) == (408, "request_timeout")
        assert "within 1 s" in message
        assert silent.read_to_end() == second.read_to_end() == idle.read_to_end() == b""


@pytest.mark.slow
def test_streams_may_last_longer_than_requests(impatient_server):
    end = time.monotonic() + 2 * SOON.header_s
    with connect(f"ws://127.0.0.1:{impatient_server.port}/") as stream:
        while time.monotonic() < end:
            stream.send(b"still there?")
            assert stream.recv(DEADLINE) == b"still there?"


@pytest.mark.slow
def test_slow_headers_end_like_missing_ones(impatient_server):
    before, answer = impatient_server.app.begun, b""
    with RawConnection(impatient_server.port) as client, suppress(ConnectionError):
        client.send(b"GET / HTTP/1.1\r\n")
        client.socket.settimeout(0.02)
        while not answer:
            client.send(b"X-A: b\r\n")
            with suppress(TimeoutError):
                answer = client.socket.recv(1 << 16)
    assert answer == b"" or b"408" in answer
    assert impatient_server.app.begun == before


@pytest.mark.slow
def test_clients_that_never_read_are_disconnected(impatient_server):
    """They send one request, one after another that was answered, or several at once."""
    with (
        RawConnection(impatient_server.port) as one,
        RawConnection(impatient_server.port) as after,
        RawConnection(impatient_server.port) as many,
    ):
        begun = impatient_server.app.begun
        one.send(LARGE)
        after.send(GET + LARGE)
        many.send(LARGE * 3)
        eventually(lambda: impatient_server.app.begun >= begun + 4)
        eventually(lambda: impatient_server.connections == 0)


@pytest.mark.slow
def test_slow_reader_gets_the_whole_answer(impatient_server, monkeypatch):
    looks = []

    def read_slowly(protocol):
        looked(protocol)
        looks.append(protocol)

    looked = GuardedProtocol._check_reading
    monkeypatch.setattr(GuardedProtocol, "_check_reading", read_slowly)
    with RawConnection(impatient_server.port) as client:
        client.send(LARGE)
        read = 0
        for _ in range(2):
            read += len(client.read_exactly(8 * MiB))
            known = len(looks)
            eventually(lambda known=known: len(looks) > known)
        rest = client.read_to_end()
    assert read + len(rest) > 64 * MiB


@pytest.mark.parametrize(
    ("sent", "refused", "text"),
    [
        (b"\x16\x03\x01 what is this\r\n\r\n", (400, "invalid_request"), ""),
        (GET[:-2] + b"X-Long: " + b"a" * 4096, (431, "too_large"), "4096 bytes"),
    ],
    ids=["no HTTP", "headers without end"],
)
def test_invalid_request_gets_the_usual_error(small_server, none_open, sent, refused, text):
    with RawConnection(small_server.port) as client:
        client.send(sent)
        status, code, message = error_of(client.read_to_end())
    assert (status, code) == refused
    assert text in message


def test_trailers_are_limited(small_server, none_open):
    with RawConnection(small_server.port) as client:
        client.send(POST + b"3\r\nabc\r\n0\r\n" + b"X-Long: ")
        eventually(lambda: small_server.connections == 1)
        with pytest.raises(ConnectionError):
            client.send(b"a" * MiB * 64)


def test_trailers_are_no_headers(small_server, none_open):
    trailers = b"Authorization: Bearer forged\r\nX-Forwarded-For: 192.0.2.1\r\n"
    with RawConnection(small_server.port) as client:
        client.send(POST + b"3\r\nabc\r\n0\r\n" + trailers + b"\r\n" + GET)
        assert [client.read_answer(), client.read_answer()] == [(200, b"3"), (200, b"hello")]
    host = (b"host", b"localhost")
    assert list(small_server.app.headers) == [[host, (b"transfer-encoding", b"chunked")], [host]]


def test_request_with_two_hosts_is_rejected(small_server, none_open):
    with RawConnection(small_server.port) as client:
        client.send(GET[:-2] + b"Host: elsewhere\r\n\r\n")
        assert error_of(client.read_to_end())[:2] == (400, "invalid_request")


def test_bodies_in_small_pieces_are_read(small_server, none_open):
    with RawConnection(small_server.port) as client:
        begun = small_server.app.begun
        client.send(POST)
        eventually(lambda: small_server.app.begun > begun)
        client.send(b"5\r\nabcde\r\n" * 2000 + b"0\r\n\r\n")
        assert client.read_answer() == (200, b"10000")


def test_extra_connections_get_an_error_until_one_ends(small_server, none_open):
    with RawConnection(small_server.port) as first, RawConnection(small_server.port) as second:
        occupy(small_server, first, second)
        with RawConnection(small_server.port) as third:
            third.send(GET)
            status, code, message = error_of(third.read_to_end())
            assert (status, code) == (429, "busy")
            assert "Too many connections: at most 2 (" in message
        with RawConnection(small_server.port) as third:
            third.send(GET[:-2] + b"Connection: Upgrade\r\nUpgrade: websocket\r\n\r\n")
            assert error_of(third.read_to_end())[:2] == (429, "busy")
        with RawConnection(small_server.port) as third:
            third.send(GET.replace(b"/", b"/health/live", 1))
            assert third.read_answer() == (200, b"hello")
    eventually(lambda: small_server.connections == 0)
    with RawConnection(small_server.port) as another:
        another.send(GET)
        assert another.read_answer() == (200, b"hello")


@pytest.mark.slow
def test_connections_far_above_the_limit_are_closed_silently(small_server, none_open):
    clients = []
    try:
        for number in range(2 + MAX_REFUSED_CONNECTIONS):
            clients.append(RawConnection(small_server.port))
            clients[-1].send(POST.replace(b"/body", b"/health/body", 1))  # any client may request this path
            eventually(lambda number=number: small_server.app.asking == number + 1)
        with RawConnection(small_server.port) as one_more:
            assert one_more.read_to_end() == b""
    finally:
        for client in clients:
            client.socket.close()


def test_silent_connections_block_nobody(small_server, none_open):
    """Far more connections than the limit, without a key, each renewed when it is closed."""
    with RawConnection(small_server.port) as asking:
        occupy(small_server, asking)
        silent = [RawConnection(small_server.port) for _ in range(600)]
        try:
            for renewed in range(20):
                with RawConnection(small_server.port) as client:
                    client.send(GET)
                    assert client.read_answer() == (200, b"hello")
                    silent[renewed].socket.close()
                    silent[renewed] = RawConnection(small_server.port)
            with RawConnection(small_server.port) as client:
                client.send(GET.replace(b"/", b"/health/live", 1))
                assert client.read_answer() == (200, b"hello")
            asking.send(b"0\r\n\r\n")
            assert asking.read_answer() == (200, b"0")  # the pending request was not dropped
        finally:
            for each in silent:
                each.socket.close()


def test_connection_without_a_request_is_dropped_first():
    with Serving(max_connections=3) as serving, RawConnection(serving.port) as kept:
        kept.send(GET)
        assert kept.read_answer() == (200, b"hello")
        with RawConnection(serving.port) as unread, RawConnection(serving.port) as silent:
            unread.send(GET)
            assert unread.read_answer() == (200, b"hello")
            with RawConnection(serving.port) as third:
                third.send(GET)
                assert third.read_answer() == (200, b"hello")
                assert silent.read_to_end() == b""
                with RawConnection(serving.port) as fourth:
                    fourth.send(GET)
                    assert fourth.read_answer() == (200, b"hello")
                    assert kept.read_to_end() == b""
                    unread.send(GET)
                    assert unread.read_answer() == (200, b"hello")


def test_connections_per_address_are_limited():
    limits = {"max_connections": 100, "max_connections_per_client": 2}
    direct = Serving(**limits, trusted_proxies="192.0.2.1")
    with direct as serving, RawConnection(serving.port) as first, RawConnection(serving.port) as second:
        occupy(serving, first, second)
        with RawConnection(serving.port) as third:
            third.send(GET)
            status, code, message = error_of(third.read_to_end())
            assert (status, code) == (429, "busy")
            assert "Too many connections from 127.0.0.1: at most 2 (" in message
        with RawConnection(serving.port) as third:
            third.send(GET.replace(b"/", b"/health/live", 1))
            assert third.read_answer() == (200, b"hello")
        first.send(b"0\r\n\r\n")
        assert first.read_answer() == (200, b"0")
        with RawConnection(serving.port) as third:  # replaces the connection that is idle now
            third.send(GET)
            assert third.read_answer() == (200, b"hello")
            assert first.read_to_end() == b""
    # a proxy's connection is exempt, as many clients share it
    with Serving(**limits, trusted_proxies="127.0.0.0/8") as serving:
        clients = [RawConnection(serving.port) for _ in range(4)]
        for client in clients:
            client.send(GET)
            assert client.read_answer() == (200, b"hello")
        assert serving.connections == 4
        for client in clients:
            client.socket.close()


def test_streams_count_as_connections_of_their_address():
    limits = {"max_connections_per_client": 1, "trusted_proxies": "192.0.2.1"}
    with Serving(**limits) as serving, connect(f"ws://127.0.0.1:{serving.port}/") as stream:
        with RawConnection(serving.port) as second:
            second.send(GET)
            assert error_of(second.read_to_end())[:2] == (429, "busy")
        stream.send(b"still there?")
        assert stream.recv(DEADLINE) == b"still there?"

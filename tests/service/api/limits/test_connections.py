"""Limits of connections: too many, silent, slow, never reading, endless; of one process and of two planes."""

import time
from contextlib import ExitStack, suppress
from unittest.mock import create_autospec

import pytest
from websockets.sync.client import connect

from service.api.limits.requests import ClientPatience
from service.api.server.connections import MAX_REFUSED_CONNECTIONS, GuardedProtocol
from tests.service.api.limits.serving import RawConnection, Serving, error_of
from tests.service.data import DEADLINE, eventually
from tests.service.planes.two_planes import TwoPlanes

MiB = 1024 * 1024
SOON = ClientPatience(header_s=1.0, answer_s=1.0)
"""Limits that are reached quickly."""
GET = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"
HEALTH = GET.replace(b"/", b"/health/live", 1)
LARGE = GET.replace(b"/ ", b"/large ", 1)
POST = b"POST /body HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"
END = b"0\r\n\r\n"
"""The end of a body."""
HELLO = (200, b"hello")


@pytest.fixture(scope="module", params=[Serving, TwoPlanes], ids=["one process", "two planes"])
def serving_kind(request):
    """The class of a server."""
    return request.param


@pytest.fixture(scope="module")
def impatient_server(serving_kind):
    """A server whose limits are reached quickly."""
    with serving_kind(patience=SOON, keep_alive_s=1) as serving:
        yield serving


@pytest.fixture(scope="module")
def started_server(serving_kind):
    """A patient server for two connections."""
    with serving_kind(patience=ClientPatience(header_bytes=4096), max_connections=2) as serving:
        yield serving


@pytest.fixture
def small_server(started_server):
    """The same server once nobody is connected and no request is counted as unanswered."""
    eventually(lambda: started_server.connections == 0 and started_server.app.asking == 0)
    return started_server


def occupy(serving, *clients):
    """Start requests that stay unanswered, as the rest of their bodies is still missing."""
    before = serving.app.asking
    for client in clients:
        client.send(POST)
    eventually(lambda: serving.app.asking == before + len(clients))


def assert_refused(serving, sent, status, code, words=""):
    """Check the error that a request gets on a connection of its own."""
    *reply, message = serving.refusal(sent)
    assert reply == [status, code]
    assert words in message


def assert_streams(stream):
    """Check that a stream returns a message."""
    stream.send(b"still there?")
    assert stream.recv(DEADLINE) == b"still there?"


def test_sequential_requests_are_answered(small_server):
    with RawConnection(small_server.port) as client:
        for _ in range(2 * 4096 // len(GET)):  # the header limit applies to each request alone
            assert client.ask(GET) == HELLO
        client.send(GET * 3)
        assert [client.read_answer() for _ in range(3)] == [HELLO] * 3


@pytest.mark.slow
def test_clients_without_a_request_are_disconnected(impatient_server):
    """All wait at the same time, as each takes a second."""
    with ExitStack() as stack:
        half, *others = (stack.enter_context(impatient_server.connect(data)) for data in (GET[:-2], b"", GET, GET))
        _, second, idle = others
        assert second.read_answer() == idle.read_answer() == HELLO
        second.send(GET[:-2])
        status, code, message = error_of(half.read_to_end())
        assert (status, code) == (408, "request_timeout")
        assert "within 1 s" in message
        assert [each.read_to_end() for each in others] == [b""] * 3


@pytest.mark.slow
def test_streams_may_last_longer_than_requests(impatient_server):
    end = time.monotonic() + 2 * SOON.header_s
    with connect(f"ws://127.0.0.1:{impatient_server.port}/") as stream:
        while time.monotonic() < end:
            assert_streams(stream)


@pytest.mark.slow
def test_slow_headers_end_like_missing_ones(impatient_server):
    before, answer = impatient_server.app.begun, b""
    with impatient_server.connect(b"GET / HTTP/1.1\r\n") as client, suppress(ConnectionError):
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
    begun = impatient_server.app.begun
    with ExitStack() as stack:
        for data in (LARGE, GET + LARGE, LARGE * 3):
            stack.enter_context(impatient_server.connect(data))
        eventually(lambda: impatient_server.app.begun >= begun + 4)
        eventually(lambda: impatient_server.connections == 0)


@pytest.mark.slow
def test_slow_reader_gets_the_whole_answer(impatient_server, monkeypatch):
    looks = create_autospec(GuardedProtocol._check_reading, side_effect=GuardedProtocol._check_reading)
    monkeypatch.setattr(GuardedProtocol, "_check_reading", looks)
    with impatient_server.connect(LARGE) as client:
        read = 0
        for _ in range(2):
            read += len(client.read_exactly(8 * MiB))
            known = looks.call_count
            eventually(lambda known=known: looks.call_count > known)
        rest = client.read_to_end()
    assert read + len(rest) > 64 * MiB


@pytest.mark.parametrize(
    ("sent", "refused"),
    [
        (b"\x16\x03\x01 what is this\r\n\r\n", (400, "invalid_request")),
        (GET[:-2] + b"X-Long: " + b"a" * 4096, (431, "too_large", "4096 bytes")),
        (GET[:-2] + b"Host: elsewhere\r\n\r\n", (400, "invalid_request")),
    ],
    ids=["no HTTP", "headers without end", "two hosts"],
)
def test_invalid_request_gets_the_usual_error(small_server, sent, refused):
    assert_refused(small_server, sent, *refused)


def test_trailers_are_limited(small_server):
    with small_server.connect(POST + b"3\r\nabc\r\n0\r\n" + b"X-Long: ") as client:
        eventually(lambda: small_server.connections == 1)
        with pytest.raises(ConnectionError):
            client.send(b"a" * MiB * 64)


def test_trailers_are_no_headers(small_server):
    trailers = b"Authorization: Bearer forged\r\nX-Forwarded-For: 192.0.2.1\r\n"
    with small_server.connect(POST + b"3\r\nabc\r\n0\r\n" + trailers + b"\r\n" + GET) as client:
        assert [client.read_answer(), client.read_answer()] == [(200, b"3"), HELLO]
    host = (b"host", b"localhost")
    assert list(small_server.app.headers) == [[host, (b"transfer-encoding", b"chunked")], [host]]


def test_bodies_in_small_pieces_are_read(small_server):
    with RawConnection(small_server.port) as client:
        occupy(small_server, client)
        assert client.ask(b"5\r\nabcde\r\n" * 2000 + END) == (200, b"10000")


def test_extra_connections_get_an_error_until_one_ends(small_server):
    with RawConnection(small_server.port) as first, RawConnection(small_server.port) as second:
        occupy(small_server, first, second)
        assert_refused(small_server, GET, 429, "busy", "Too many connections: at most 2 (")
        assert_refused(small_server, GET[:-2] + b"Connection: Upgrade\r\nUpgrade: websocket\r\n\r\n", 429, "busy")
        assert small_server.ask(HEALTH) == HELLO
    eventually(lambda: small_server.connections == 0)
    assert small_server.ask(GET) == HELLO


@pytest.mark.slow
def test_connections_far_above_the_limit_are_closed_silently(small_server):
    with ExitStack() as stack:
        for number in range(2 + MAX_REFUSED_CONNECTIONS):
            # any client may request this path
            stack.enter_context(small_server.connect(POST.replace(b"/body", b"/health/body", 1)))
            eventually(lambda number=number: small_server.app.asking == number + 1)
        with RawConnection(small_server.port) as one_more:
            assert one_more.read_to_end() == b""


def test_silent_connections_block_nobody(small_server):
    """Far more connections than the limit, without a key, each renewed when it is closed."""
    with RawConnection(small_server.port) as asking, ExitStack() as stack:
        occupy(small_server, asking)
        silent = [stack.enter_context(RawConnection(small_server.port)) for _ in range(600)]
        for renewed in silent[:20]:
            with small_server.connect(GET) as client:
                assert client.read_answer() == HELLO
                renewed.socket.close()
                stack.enter_context(RawConnection(small_server.port))
        assert small_server.ask(HEALTH) == HELLO
        assert asking.ask(END) == (200, b"0")  # the pending request was not dropped


def test_connection_without_a_request_is_dropped_first(serving_kind):
    with serving_kind(max_connections=3) as serving, RawConnection(serving.port) as kept:
        assert kept.ask(GET) == HELLO
        with RawConnection(serving.port) as unread, RawConnection(serving.port) as silent:
            assert unread.ask(GET) == HELLO
            with RawConnection(serving.port) as third:
                assert third.ask(GET) == HELLO
                assert silent.read_to_end() == b""
                with RawConnection(serving.port) as fourth:
                    assert fourth.ask(GET) == HELLO
                    assert kept.read_to_end() == b""
                    assert unread.ask(GET) == HELLO


def test_connections_per_address_are_limited(serving_kind):
    limits = {"max_connections": 100, "max_connections_per_client": 2}
    direct = serving_kind(**limits, trusted_proxies="192.0.2.1")
    with direct as serving, RawConnection(serving.port) as first, RawConnection(serving.port) as second:
        occupy(serving, first, second)
        assert_refused(serving, GET, 429, "busy", "Too many connections from 127.0.0.1: at most 2 (")
        assert serving.ask(HEALTH) == HELLO
        assert first.ask(END) == (200, b"0")
        with RawConnection(serving.port) as third:  # replaces the connection that is idle now
            assert third.ask(GET) == HELLO
            assert first.read_to_end() == b""
    # a proxy's connection is exempt, as many clients share it
    with serving_kind(**limits, trusted_proxies="127.0.0.0/8") as serving, ExitStack() as stack:
        for _ in range(4):
            assert stack.enter_context(RawConnection(serving.port)).ask(GET) == HELLO
        # one that is on its way to the other plane counts twice for a moment
        assert eventually(lambda: serving.connections == 4)


def test_streams_count_as_connections_of_their_address(serving_kind):
    limits = {"max_connections_per_client": 1, "trusted_proxies": "192.0.2.1"}
    with serving_kind(**limits) as serving, connect(f"ws://127.0.0.1:{serving.port}/") as stream:
        assert_refused(serving, GET, 429, "busy")
        assert_streams(stream)

"""Connections: too many, silent, slow, unread, endless."""

import time
from contextlib import suppress

import pytest
from websockets.sync.client import connect

from service.api.limits.requests import ClientPatience
from service.api.server.connections import REFUSED, GuardedProtocol
from tests.service.data import DEADLINE, eventually
from tests.service.limits.serving import Raw, Serving, refusal

MiB = 1024 * 1024
SOON = ClientPatience(header_s=1.0, answer_s=1.0)
"""Limits that are soon reached."""
GET = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"
LARGE = GET.replace(b"/ ", b"/large ", 1)
POST = b"POST /body HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"


@pytest.fixture(scope="module")
def soon():
    """A server whose limits are soon reached."""
    with Serving(patience=SOON, keep_alive_s=1) as serving:
        yield serving


@pytest.fixture(scope="module")
def few():
    """A server for two connections that keeps them."""
    with Serving(patience=ClientPatience(header_bytes=4096), max_connections=2) as serving:
        yield serving


@pytest.fixture
def none_open(few):
    """The same, once nobody is connected any more, and what was asked is not counted as being answered."""
    eventually(lambda: few.connections == 0 and few.app.asking == 0)
    return few


def occupy(serving, *clients):
    """Let clients ask something that is not answered yet: the rest of their bodies is still to come."""
    before = serving.app.asking
    for client in clients:
        client.send(POST)
    eventually(lambda: serving.app.asking == before + len(clients))


def test_requests_one_after_the_other_are_answered(few, none_open):
    with Raw(few.port) as client:
        for _ in range(2 * 4096 // len(GET)):  # headers of many requests are not those of one
            client.send(GET)
            assert client.answer() == (200, b"hello")
        client.send(GET * 3)
        assert [client.answer() for _ in range(3)] == [(200, b"hello")] * 3


def test_clients_that_do_not_ask_are_let_go(soon):
    """All at the same time: each would take a second."""
    with Raw(soon.port) as silent, Raw(soon.port) as half, Raw(soon.port) as second, Raw(soon.port) as idle:
        half.send(GET[:-2])
        second.send(GET)
        idle.send(GET)
        assert second.answer() == idle.answer() == (200, b"hello")
        second.send(GET[:-2])
        status, code, message = refusal(half.rest())
        assert (status, code) == (408, "request_timeout")
        assert "within 1 s" in message
        assert silent.rest() == second.rest() == idle.rest() == b""


@pytest.mark.slow
def test_streams_outlast_what_requests_may_take(soon):
    end = time.monotonic() + 2 * SOON.header_s
    with connect(f"ws://127.0.0.1:{soon.port}/") as stream:
        while time.monotonic() < end:
            stream.send(b"still there?")
            assert stream.recv(DEADLINE) == b"still there?"


def test_headers_that_trickle_end_as_those_that_stop(soon):
    before, answer = soon.app.begun, b""
    with Raw(soon.port) as client, suppress(ConnectionError):
        client.send(b"GET / HTTP/1.1\r\n")
        client.socket.settimeout(0.02)
        while not answer:
            client.send(b"X-A: b\r\n")
            with suppress(TimeoutError):
                answer = client.socket.recv(1 << 16)
    assert answer == b"" or b"408" in answer
    assert soon.app.begun == before


def test_clients_that_read_nothing_are_cut_off(soon):
    """One request, one after another that was answered, and several at once."""
    with Raw(soon.port) as one, Raw(soon.port) as after, Raw(soon.port) as many:
        begun = soon.app.begun
        one.send(LARGE)
        after.send(GET + LARGE)
        many.send(LARGE * 3)
        eventually(lambda: soon.app.begun >= begun + 4)
        eventually(lambda: soon.connections == 0)


def test_a_client_that_reads_slowly_gets_all(soon, monkeypatch):
    looks = []

    def look(protocol):
        looked(protocol)
        looks.append(protocol)

    looked = GuardedProtocol._look_reading
    monkeypatch.setattr(GuardedProtocol, "_look_reading", look)
    with Raw(soon.port) as client:
        client.send(LARGE)
        read = 0
        for _ in range(2):
            read += len(client.exactly(8 * MiB))
            known = len(looks)
            eventually(lambda known=known: len(looks) > known)
        rest = client.rest()
    assert read + len(rest) > 64 * MiB


@pytest.mark.parametrize(
    ("sent", "refused", "text"),
    [
        (b"\x16\x03\x01 what is this\r\n\r\n", (400, "invalid_request"), ""),
        (GET[:-2] + b"X-Long: " + b"a" * 4096, (431, "too_large"), "4096 bytes"),
    ],
    ids=["no HTTP", "headers without end"],
)
def test_what_is_no_request_is_answered_as_any_error(few, none_open, sent, refused, text):
    with Raw(few.port) as client:
        client.send(sent)
        status, code, message = refusal(client.rest())
    assert (status, code) == refused
    assert text in message


def test_headers_after_a_body_have_an_end_too(few, none_open):
    with Raw(few.port) as client:
        client.send(POST + b"3\r\nabc\r\n0\r\n" + b"X-Long: ")
        eventually(lambda: few.connections == 1)
        with pytest.raises(ConnectionError):
            client.send(b"a" * MiB * 64)


def test_trailers_are_no_headers(few, none_open):
    trailers = b"Authorization: Bearer forged\r\nX-Forwarded-For: 192.0.2.1\r\n"
    with Raw(few.port) as client:
        client.send(POST + b"3\r\nabc\r\n0\r\n" + trailers + b"\r\n" + GET)
        assert [client.answer(), client.answer()] == [(200, b"3"), (200, b"hello")]
    host = (b"host", b"localhost")
    assert list(few.app.headers) == [[host, (b"transfer-encoding", b"chunked")], [host]]


def test_a_request_to_two_hosts_is_refused(few, none_open):
    with Raw(few.port) as client:
        client.send(GET[:-2] + b"Host: elsewhere\r\n\r\n")
        assert refusal(client.rest())[:2] == (400, "invalid_request")


def test_bodies_in_small_pieces_are_taken(few, none_open):
    with Raw(few.port) as client:
        begun = few.app.begun
        client.send(POST)
        eventually(lambda: few.app.begun > begun)
        client.send(b"5\r\nabcde\r\n" * 2000 + b"0\r\n\r\n")
        assert client.answer() == (200, b"10000")


def test_more_connections_than_allowed_are_told_so_until_one_ends(few, none_open):
    with Raw(few.port) as first, Raw(few.port) as second:
        occupy(few, first, second)
        with Raw(few.port) as third:
            third.send(GET)
            status, code, message = refusal(third.rest())
            assert (status, code) == (429, "busy")
            assert "2 connections are open" in message
        with Raw(few.port) as third:
            third.send(GET[:-2] + b"Connection: Upgrade\r\nUpgrade: websocket\r\n\r\n")
            assert refusal(third.rest())[:2] == (429, "busy")
        with Raw(few.port) as third:
            third.send(GET.replace(b"/", b"/health/live", 1))
            assert third.answer() == (200, b"hello")
    eventually(lambda: few.connections == 0)
    with Raw(few.port) as another:
        another.send(GET)
        assert another.answer() == (200, b"hello")


def test_connections_far_beyond_the_most_are_not_even_told(few, none_open):
    clients = []
    try:
        for number in range(2 + REFUSED):
            clients.append(Raw(few.port))
            clients[-1].send(POST.replace(b"/body", b"/health/body", 1))  # which all may ask for
            eventually(lambda number=number: few.app.asking == number + 1)
        with Raw(few.port) as one_more:
            assert one_more.rest() == b""
    finally:
        for client in clients:
            client.socket.close()


def test_who_asks_nothing_keeps_nobody_out(few, none_open):
    """Renewed as often as they are closed, many more than there may be, and without a key."""
    with Raw(few.port) as asking:
        occupy(few, asking)
        silent = [Raw(few.port) for _ in range(600)]
        try:
            for renewed in range(20):
                with Raw(few.port) as client:
                    client.send(GET)
                    assert client.answer() == (200, b"hello")
                    silent[renewed].socket.close()
                    silent[renewed] = Raw(few.port)
            with Raw(few.port) as client:
                client.send(GET.replace(b"/", b"/health/live", 1))
                assert client.answer() == (200, b"hello")
            asking.send(b"0\r\n\r\n")
            assert asking.answer() == (200, b"0")  # what is being answered has not given way
        finally:
            for each in silent:
                each.socket.close()


def test_who_has_never_asked_gives_way_first_then_who_asked_longest_ago():
    with Serving(max_connections=3) as serving, Raw(serving.port) as kept:
        kept.send(GET)
        assert kept.answer() == (200, b"hello")
        with Raw(serving.port) as unread, Raw(serving.port) as silent:
            unread.send(GET)
            assert unread.answer() == (200, b"hello")
            with Raw(serving.port) as third:
                third.send(GET)
                assert third.answer() == (200, b"hello")
                assert silent.rest() == b""
                with Raw(serving.port) as fourth:
                    fourth.send(GET)
                    assert fourth.answer() == (200, b"hello")
                    assert kept.rest() == b""
                    unread.send(GET)
                    assert unread.answer() == (200, b"hello")


def test_one_address_has_its_own_most():
    limits = {"max_connections": 100, "max_connections_per_client": 2}
    direct = Serving(**limits, trusted_proxies="192.0.2.1")
    with direct as serving, Raw(serving.port) as first, Raw(serving.port) as second:
        occupy(serving, first, second)
        with Raw(serving.port) as third:
            third.send(GET)
            status, code, message = refusal(third.rest())
            assert (status, code) == (429, "busy")
            assert "127.0.0.1 has 2 connections" in message
        with Raw(serving.port) as third:
            third.send(GET.replace(b"/", b"/health/live", 1))
            assert third.answer() == (200, b"hello")
        first.send(b"0\r\n\r\n")
        assert first.answer() == (200, b"0")
        with Raw(serving.port) as third:  # takes the place of the one that rests now
            third.send(GET)
            assert third.answer() == (200, b"hello")
            assert first.rest() == b""
    with Serving(**limits, trusted_proxies="127.0.0.0/8") as serving:  # a proxy's: behind it are many
        clients = [Raw(serving.port) for _ in range(4)]
        for client in clients:
            client.send(GET)
            assert client.answer() == (200, b"hello")
        assert serving.connections == 4
        for client in clients:
            client.socket.close()


def test_streams_count_among_the_connections_of_an_address():
    limits = {"max_connections_per_client": 1, "trusted_proxies": "192.0.2.1"}
    with Serving(**limits) as serving, connect(f"ws://127.0.0.1:{serving.port}/") as stream:
        with Raw(serving.port) as second:
            second.send(GET)
            assert refusal(second.rest())[:2] == (429, "busy")
        stream.send(b"still there?")
        assert stream.recv(DEADLINE) == b"still there?"

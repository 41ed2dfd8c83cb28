"""C++ client against services that are slow, send fragments, break the protocol, or close."""

import socket
import threading

import numpy as np
import pytest

from tests.clients.cpp.driver import Driver
from tests.clients.cpp.services import HELLO, Talk, answer, frame, head_of, serving, streaming, upgraded
from tests.service.data import DEADLINE, eventually

ROWS = np.arange(80.0).reshape(10, 4, 2) / 100
FAR = f"{DEADLINE:g}"


def reading(talk: Talk) -> None:
    """Read until the client closes."""
    while True:
        talk.read()


def answering(talk: Talk) -> None:
    """Answer until the client closes."""
    while True:
        talk.answer(talk.request())


def test_answers_in_single_bytes_and_fragments_with_pings_are_read(driver):
    pongs = []

    def cut(talk):
        talk.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sequence = talk.request()
        data = answer(sequence, 2.5)
        parts = frame(0x02, data[:10]) + frame(0x89, b"there?") + frame(0x00, b"") + frame(0x80, data[10:])
        for byte in parts:
            talk.connection.sendall(bytes([byte]))
        pongs.append(talk.read())
        reading(talk)

    with serving(streaming(cut)) as url, Driver(driver, ROWS, model="m", url=url) as client:
        assert client.do(f"connect {FAR}")["status"] == "ok"
        report = client.do(f"ask 0 {FAR}")
        assert (report["status"], report["tau"]) == ("ok", [2.5, -2.5])
        assert client.do("tick")["connected"]
    assert pongs == [(10, b"there?")]


def test_too_large_text_is_skipped(driver):
    def talkative(talk):
        talk.text(news="x" * 300_000)
        answering(talk)

    with serving(streaming(talkative)) as url, Driver(driver, ROWS, model="m", url=url) as client:
        assert client.do(f"ask 0 {FAR}")["status"] == "ok"


def test_late_answer_is_not_used_for_the_next_query(driver):
    def slow(talk):
        first, second = talk.request(), talk.request()  # the second is sent when the client has given up the first
        talk.answer(first, 1.0)
        talk.answer(second, 2.0)
        answering(talk)

    with serving(streaming(slow)) as url, Driver(driver, ROWS, model="m", url=url) as client:
        client.do(f"connect {FAR}")
        report = client.do("ask 0 0.05")
        assert (report["status"], report["code"]) == ("timeout", "timeout")
        report = client.do(f"ask 1 {FAR}")
        assert (report["status"], report["sequence"], report["tau"]) == ("ok", 2, [2.0, -2.0])
        assert (report["asked"], report["answered"], report["stale"]) == (2, 1, 1)


def test_silent_service_gets_at_most_a_window_of_queries_and_is_dropped(driver):
    seen = []

    def mute(talk):
        while True:
            seen.append(talk.request())

    options = {"model": "m", "window": 3, "silence_s": 0.4}
    with serving(streaming(mute), streaming(answering)) as url, Driver(driver, ROWS, url=url, **options) as client:
        client.do(f"connect {FAR}")
        assert client.do("ask 0 0.001")["status"] == "timeout"
        for _ in range(5):
            client.do("ask 0 0.001")
        report = client.do(f"ask 0 {FAR}")  # by the next connection
        assert (report["status"], report["losses"], report["connections"]) == ("ok", 1, 2)
        assert "silence_s" in report["message"]
    assert len(seen) <= 3


def test_unacknowledged_torques_are_sent_again_in_order(driver):
    first, second = [], []

    def forgetful(talk):
        for _ in range(4):
            first.append(talk.request())
            talk.answer(first[-1])
        talk.text(learnt={"through": 2, "accepted": 1, "duplicates": 0, "rejected": {"limit": 1}, "revision": 4})

    def careful(talk):
        for _ in range(5):
            second.append(talk.request())
            talk.answer(second[-1])
        talk.text(learnt={"through": 7, "accepted": 3, "duplicates": 2, "rejected": {}, "revision": 5})
        reading(talk)

    options = {"model": "m", "stream_id": "arm", "window": 2}
    with (
        serving(streaming(forgetful), streaming(careful)) as url,
        Driver(driver, ROWS, url=url, **options) as client,
    ):
        assert client.do("teach 0 7")["status"] == "ok"  # before there is a connection
        report = client.do(f"flush {FAR}")
    assert (first, second) == ([1, 2, 3, 4], [3, 4, 5, 6, 7])
    assert (report["status"], report["unsettled"], report["through"]) == ("ok", 0, 7)
    assert (report["accepted"], report["duplicates"], report["rejected"]) == (4, 2, 1)
    assert (report["learnt_revision"], report["losses"]) == (5, 1)
    assert 2 <= report["resent"] <= 4  # 3 and 4, and what was on its way


def test_refused_torques_are_counted_and_explained(driver):
    def strict(talk):
        for sequence in (1, 2, 3):
            assert talk.request() == sequence
        talk.answer(1)
        talk.refuse(2, 'tau is "wrong"')
        talk.answer(3)
        error = {"code": "storage_full", "message": "the disk is full", "detail": []}
        talk.text(refused={"first": 1, "through": 3, "error": error})
        talk.refuse(talk.request(), "q[1] is 99: degrees?")
        answering(talk)

    with serving(streaming(strict)) as url, Driver(driver, ROWS, model="m", url=url, stream_id="arm") as client:
        client.do("teach 0 3")
        report = client.do(f"flush {FAR}")
        assert (report["status"], report["refused"], report["refusal"]) == ("ok", 3, "the disk is full")
        report = client.do(f"ask 0 {FAR}")
        assert (report["status"], report["message"]) == ("refused", "q[1] is 99: degrees?")
        assert client.do(f"ask 0 {FAR}")["status"] == "ok"


def test_large_output_is_sent_in_parts(driver):
    """100 frames of 1000 joints, 3 MB: more than the sockets can buffer."""
    measured = np.random.default_rng(0).uniform(-1, 1, (100, 4, 1000))
    may_read, seen = threading.Event(), []

    def slow(talk):
        assert may_read.wait(DEADLINE)
        for sequence in range(1, 101):
            opcode, payload = talk.read()
            seen.append(opcode == 2 and payload[16:] == measured[sequence - 1].tobytes())
            talk.answer(sequence)
        talk.text(learnt={"through": 100, "accepted": 100, "duplicates": 0, "rejected": {}, "revision": 1})
        reading(talk)

    names = [f"joint {k}" for k in range(1000)]
    options = {"model": "m", "stream_id": "arm", "window": 100}
    service = streaming(slow, joint_names=names, noise_std=[0.1] * 1000)
    with serving(service) as url, Driver(driver, measured, url=url, **options) as client:
        assert client.do(f"connect {FAR}")["status"] == "ok"
        assert client.do("teach 0 100")["unsettled"] == 100
        may_read.set()
        assert client.do(f"flush {FAR}")["accepted"] == 100
    assert seen == [True] * 100


def test_full_backlog_keeps_no_more_torques_but_still_asks(driver):
    options = {"model": "m", "stream_id": "arm", "backlog": 4}
    with serving(streaming(answering)) as url, Driver(driver, ROWS, url=url, **options) as client:
        client.do(f"connect {FAR}")
        report = client.do("teach 0 5")
        assert (report["status"], report["taught"], report["unsettled"]) == ("full", 4, 4)
        assert "backlog" in report["message"]
        assert client.do(f"ask 0 {FAR} learn")["status"] == "full"
        assert client.do(f"ask 0 {FAR}")["status"] == "ok"


def test_close_is_answered_and_its_reason_kept(driver):
    replies, released = [], threading.Event()

    def closing(talk):
        talk.request()
        talk.send(0x88, (1008).to_bytes(2, "big") + b"the key was revoked")
        replies.append(talk.read())

    def wait(connection: socket.socket) -> None:
        released.wait(DEADLINE)

    with serving(streaming(closing), wait) as url, Driver(driver, ROWS, model="m", url=url) as client:
        client.do(f"connect {FAR}")
        report = eventually(lambda: (seen := client.do("ask 0 0.1"))["close"] and seen)
        released.set()
    assert (report["status"], report["code"], report["close"]) == ("unreachable", "closed", 1008)
    assert "the key was revoked" in report["message"]
    assert replies == [(8, (1008).to_bytes(2, "big"))]


def masked(talk: Talk) -> None:
    talk.request()
    talk.connection.sendall(b"\x82\x81\0\0\0\0x")
    reading(talk)


def unasked(talk: Talk) -> None:
    talk.answer(99)
    reading(talk)


def out_of_order(talk: Talk) -> None:
    talk.answer(talk.request() + 1)
    reading(talk)


def too_short(talk: Talk) -> None:
    talk.send(0x82, answer(talk.request())[:-8])
    reading(talk)


def other_key(connection: socket.socket) -> None:
    upgraded(connection, key="dGhlIHNhbXBsZSBub25jZQ==")
    connection.recv(1)


def no_http(connection: socket.socket) -> None:
    head_of(connection)
    connection.sendall(b"SSH-2.0-OpenSSH_9.2\r\n\r\n")


def no_stream(connection: socket.socket) -> None:
    head_of(connection)
    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nhi")


def endless(connection: socket.socket) -> None:
    head_of(connection)
    connection.sendall(b"HTTP/1.1 101 Switching Protocols\r\n" + b"X: y\r\n" * 5000)


@pytest.mark.parametrize(
    ("service", "words"),
    [
        (streaming(masked), "masked"),
        (streaming(unasked), "an answer"),
        (streaming(out_of_order), "out of order"),
        (streaming(too_short), "length does not match"),
        (streaming(reading, layout=2), "layout"),
        (streaming(reading, joint_names=["a", "b", "c"]), "joints is 2, expected 3"),
        (other_key, "wrong Sec-WebSocket-Accept"),
        (no_http, "is not an HTTP server"),
        (no_stream, "status 200"),
        (endless, "headers of the HTTP answer are too long"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_protocol_errors_end_the_connection_and_are_explained(driver, service, words):
    released = threading.Event()

    def wait(connection: socket.socket) -> None:
        released.wait(DEADLINE)

    with serving(service, wait) as url, Driver(driver, ROWS, model="m", url=url) as client:

        def tried():
            report = client.do("connect 0.1")
            return client.do("ask 0 0.1") if report["status"] == "ok" else report

        report = eventually(lambda: words in (seen := tried())["message"] and seen)
        released.set()
    assert report["status"] != "ok"
    assert not report["connected"]


def test_deadline_limits_the_wait_for_a_connection(driver):
    with socket.create_server(("127.0.0.1", 0)) as server:  # accepts nothing
        url = f"http://127.0.0.1:{server.getsockname()[1]}"
        with Driver(driver, ROWS, model="m", url=url, attempt_s=0.05) as client:
            report = eventually(lambda: "attempt_s" in (seen := client.do("connect 0.1"))["message"] and seen)
            assert (report["status"], report["connected"]) == ("unreachable", 0)


def test_first_message_is_read(driver):
    with serving(streaming(reading)) as url, Driver(driver, ROWS, model="m", url=url) as client:
        report = client.do(f"connect {FAR}")
        assert (report["model_version"], report["first_joint"]) == (HELLO["version"], "a")
        assert report["torque_convention"] == HELLO["torque_convention"]
        np.testing.assert_allclose(report["noise_std"], HELLO["noise_std"], rtol=1e-15)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"url": "https://robot:8000"}, "no TLS"),
        ({"url": "wss://robot:8000"}, "no TLS"),
        ({"url": "robot:8000"}, "expected http://host:port or unix:///path"),
        ({"url": "http://robot:8000/there"}, "no path"),
        ({"url": "unix://there"}, "absolute path"),
        ({"url": "unix:///" + "x" * 200}, "shorter path"),
        ({"url": "http://no.such.host.invalid:1"}, "no address found for no.such.host.invalid"),
        ({"model": ""}, "model"),
        ({"joints": 0}, "joints"),
        ({"key": "lip_a b"}, "key (or LIPSERVE_API_KEY)"),
        ({"alias": "production", "version": 1}, "alias"),
        ({"alias": "production", "stream_id": "arm"}, "stream_id"),
        ({"window": 0}, "window"),
    ],
)
def test_invalid_options_are_explained_and_every_call_returns_invalid(driver, options, words):
    with Driver(driver, **{"model": "m", "url": "http://127.0.0.1:1", **options}) as client:
        report = client.do(f"connect {FAR}")
        assert (report["status"], client.do(f"flush {FAR}")["status"]) == ("invalid", "invalid")
        assert words in report["message"]
        assert "lip_a" not in report["message"]

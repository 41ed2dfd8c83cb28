"""Connections that pass between the planes give the answers that one process gives."""

import fcntl
import random
import socket
import termios
import time
from contextlib import suppress
from pathlib import Path

import pytest

from service.planes.handover import MAX_QUERY_BYTES, OTHER, PART, find_query
from tests.service.api.limits.serving import Serving
from tests.service.data import DEADLINE
from tests.service.planes.requests import ECHO, HOST, PAGE, QUERY, STREAM, Digest, echo
from tests.service.planes.two_planes import TwoPlanes


@pytest.mark.parametrize(
    ("data", "found"),
    [
        (QUERY, len(QUERY)),
        (QUERY + PAGE, len(QUERY)),
        (QUERY[:-1], PART),
        (QUERY[:1], PART),
        (QUERY.replace(b"Content-Length", b"content-LENGTH"), len(QUERY)),
        (b"GET /health/live HTTP/1.1\r\n" + HOST + b"\r\n", len(b"GET /health/live HTTP/1.1\r\n" + HOST + b"\r\n")),
        (STREAM, len(STREAM)),
        (STREAM[:40], PART),
        (PAGE, OTHER),
        (b"HEAD /health/live HTTP/1.1\r\n" + HOST + b"\r\n", OTHER),
        (b"\r\n" + QUERY, OTHER),
        (QUERY.replace(b"\r\n", b"\n"), OTHER),
        (QUERY.replace(b"HTTP/1.1", b"HTTP/1.0"), OTHER),
        (QUERY.replace(b"predict", b"predict?a=b"), OTHER),
        (QUERY.replace(b"Content-Length: 3", b"Transfer-Encoding: chunked"), OTHER),
        (QUERY.replace(HOST, HOST + b"Expect: 100-continue\r\n"), OTHER),
        (QUERY.replace(HOST, HOST + b"Upgrade: h2c\r\n"), OTHER),
        (QUERY.replace(HOST, HOST + b"Content-Encoding: gzip\r\n"), OTHER),
        (QUERY.replace(HOST, HOST + b"Content-Length: 4\r\n"), OTHER),
        (QUERY.replace(HOST, b"X: a\r\n b\r\n"), OTHER),
        (QUERY.replace(b"Length: 3", b"Length: 17000"), OTHER),
        (STREAM.replace(HOST, HOST + b"Content-Length: 3\r\n"), OTHER),
        (b"POST /v1/models/arm/predict HTTP/1.1\r\nX: " + bytes(MAX_QUERY_BYTES), OTHER),
    ],
)
def test_plain_whole_requests_are_queries(data, found):
    assert find_query(data) == found


def random_request(random_number: random.Random) -> bytes:
    """Return a correct request of one of many kinds."""
    body = bytes(random_number.randrange(256) for _ in range(random_number.choice((0, 1, 40, 3000))))
    late = b"later" + body
    large = bytes(random_number.choice((17_000, 70_000)))
    post = b"POST %b HTTP/1.1\r\n" + HOST
    chunk = b"%x\r\n%b\r\n" % (len(late), late)
    kinds = (
        echo(body),
        echo(body),
        echo(body),
        echo(late),
        PAGE,
        b"GET /health/live HTTP/1.1\r\n" + HOST + b"\r\n",
        b"HEAD /health/live HTTP/1.1\r\n" + HOST + b"\r\n",
        echo(large),
        post % b"/v1/datasets" + b"Content-Length: %d\r\n\r\n%b" % (len(late), late),
        post % b"/v1/echo" + b"Transfer-Encoding: chunked\r\n\r\n" + chunk + chunk + b"0\r\n\r\n",
        post % b"/early" + b"Content-Length: %d\r\n\r\n%b" % (len(QUERY), QUERY),  # a body that looks like a query
        b"\r\n" + PAGE,
    )
    return random_number.choice(kinds)


CLOSING = (
    PAGE[:-2] + b"Connection: close\r\n\r\n",
    ECHO.replace(HOST, HOST + b"Connection: close\r\n") % (3, b"abc"),
)
"""Requests after which the server closes the connection."""
MALFORMED = (
    b"no HTTP\r\n\r\n",
    QUERY.replace(HOST, HOST + HOST),
    ECHO.replace(HOST, HOST + b"Content-Length: 1\r\n") % (3, b"abc"),
    QUERY.replace(b"Length: 3", b"Length: +3"),
)
"""Bytes that are no request. The server closes the connection at once: earlier answers may be missing."""


def pieces_of(data: bytes, random_number: random.Random) -> list[bytes]:
    """Return the data in a few pieces of random sizes."""
    cuts = sorted(random_number.randrange(len(data) + 1) for _ in range(random_number.choice((0, 1, 5, 20))))
    return [data[start:end] for start, end in zip([0, *cuts], [*cuts, len(data)], strict=True) if end > start]


def converse(path: Path, pieces: list[bytes]) -> bytes:
    """Send pieces one by one, each once the server has read the last one or has stopped reading; return all answers."""
    received = b""
    with connect(path) as client, suppress(ConnectionError):
        for piece in pieces:
            client.sendall(piece)
            until = time.monotonic() + 0.02
            while int.from_bytes(fcntl.ioctl(client, termios.TIOCOUTQ, bytes(4)), "little"):
                if time.monotonic() > until:
                    break
        while more := client.recv(1 << 16):
            received += more
    return received


def ask_each(path: Path, requests: list[bytes]) -> bytes:
    """Send requests, each once the last one was answered; return all answers."""
    received = b""
    with connect(path) as client:
        for request in requests:
            client.sendall(request)
            answer = b""
            while b"\r\n\r\n" not in answer:
                answer += client.recv(1 << 16)
            head, _, content = answer.partition(b"\r\n\r\n")
            length = (
                0 if request.startswith(b"HEAD") else int(head.lower().partition(b"content-length: ")[2].split()[0])
            )
            while len(content) < length:
                more = client.recv(1 << 16)
                content, answer = content + more, answer + more
            received += answer
    return received


def connect(path: Path) -> socket.socket:
    """Return a connection to a Unix-domain socket."""
    client = socket.socket(socket.AF_UNIX)
    client.settimeout(DEADLINE)
    client.connect(str(path))
    return client


def listener(folder: Path) -> socket.socket:
    made = socket.socket(socket.AF_UNIX)
    made.bind(str(folder / "socket"))
    made.listen(8)
    return made


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """One process and two planes with the same application, at Unix-domain sockets."""
    folders = [tmp_path_factory.mktemp(name) for name in ("one", "two")]
    one, two = (listener(folder) for folder in folders)
    digests = Digest(), Digest()
    with (
        TwoPlanes(with_app=digests[0], unix=two) as planes,
        Serving(with_app=digests[1], unix=one),
    ):
        yield [folder / "socket" for folder in folders], planes


@pytest.mark.parametrize("seed", range(60))
def test_any_pieces_of_any_requests_get_the_answers_of_one_process(both, seed):
    (one, two), _ = both
    number = random.Random(seed)
    requests = [random_request(number) for _ in range(number.randrange(8))] + [number.choice(CLOSING)]
    assert converse(two, pieces_of(b"".join(requests), number)) == ask_each(one, requests)


@pytest.mark.parametrize("seed", range(20))
def test_malformed_bytes_get_no_wrong_answer(both, seed):
    (one, two), _ = both
    number = random.Random(seed)
    requests, malformed = [random_request(number) for _ in range(number.randrange(4))], number.choice(MALFORMED)
    *answers, error = converse(two, pieces_of(b"".join([*requests, malformed]), number)).partition(b"HTTP/1.1 4")[::2]
    assert error.startswith(b"00 Bad Request") or not error
    assert ask_each(one, requests).startswith(answers[0])

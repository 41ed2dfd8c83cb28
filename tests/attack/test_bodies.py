"""Bodies of every route: sizes around each limit, wrong types, cut bodies and wrong lengths."""

import json
import socket
from collections.abc import Iterator
from contextlib import suppress
from random import Random
from typing import Any, NamedTuple

import pytest

from service.api.limits.requests import body_limit, body_limits
from service.foundation.settings import Settings
from tests.attack.attacked import DEADLINE, AttackedService, attack_random, is_documented

METHODS = ("get", "put", "post", "delete")
LIMITS = {"MAX_UPLOAD_BYTES": "300000", "MAX_REQUEST_BYTES": "100000", "MAX_UNPACKED_BYTES": "3000000"}
MAX_SENT_BYTES = 4_000_000
"""Largest body that is sent; above it only its length is."""
KNOWN = {"model": "panda-sim", "version": "1", "alias": "unknown", "name": "panda"}
"""Values of path parameters that exist, so that a body is read; all others name nothing."""
TYPES = (
    *(
        "",
        "text/plain",
        "application/octet-stream",
        "application/json; charset=utf-16",
        "multipart/form-data",
        "a" * 9000,
    ),
    *(
        "multipart/form-data; boundary=",
        "multipart/form-data; boundary=x",
        "application/x-www-form-urlencoded",
        ";;;=/",
    ),
)
OVERFLOW = b"f" * 17
CHUNKED = b"transfer-encoding: chunked\r\n"
FRAMINGS = {
    "negative length": (b"content-length: -1\r\n", b"{}"),
    "no number": (b"content-length: 1e3\r\n", b"{}"),
    "huge length": (b"content-length: " + b"9" * 30 + b"\r\n", b"{}"),
    "two lengths": (b"content-length: 2\r\ncontent-length: 9\r\n", b"{}"),
    "length and chunks": (b"content-length: 2\r\n" + CHUNKED, b"2\r\n{}\r\n0\r\n\r\n"),
    "short length": (b"content-length: 1\r\n", b'{"q": [1]}'),
    "long length": (b"content-length: 900\r\n", b"{}"),
    "no length": (b"", b"{}"),
    "no chunk": (CHUNKED, b"zz\r\n{}\r\n0\r\n\r\n"),
    "huge chunk": (CHUNKED, OVERFLOW + b"\r\n{}\r\n"),
    "negative chunk": (CHUNKED, b"-2\r\n{}\r\n0\r\n\r\n"),
    "long extension": (CHUNKED, b"2;" + b"a" * 70_000 + b"\r\n{}\r\n0\r\n\r\n"),
    "chunk cut off": (CHUNKED, b"ff\r\n{}"),
}


class Route(NamedTuple):
    """An operation of the OpenAPI document; kinds: media types of its body."""

    method: str
    path: str
    kinds: tuple[str, ...]


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AttackedService]:
    with AttackedService(tmp_path_factory.mktemp("bodies"), populated=False, **LIMITS) as service:
        yield service


@pytest.fixture(scope="module")
def routes(attacked: AttackedService) -> list[Route]:
    found = []
    for path, operations in attacked.client.get("/openapi.json").json()["paths"].items():
        for method in METHODS:
            if method in operations and path != "/v1/models/{model}/refresh":  # it would train
                kinds = tuple(operations[method].get("requestBody", {}).get("content", {}))
                found.append(Route(method.upper(), _fill(method, path), kinds))
    assert len(found) > 60
    return found


def _fill(method: str, path: str) -> str:
    """Return a path without parameters. Nothing is deleted, and no answer is endless."""
    harmless = method != "delete" and not path.endswith("/live")
    for name in ("model", "version", "alias", "name", "dataset", "robot", "job", "stream_id", "sequence"):
        path = path.replace(f"{{{name}}}", KNOWN[name] if harmless and name in KNOWN else "0")
    return path


def exchange(attacked: AttackedService, data: bytes, finish: bool = False) -> list[tuple[int, bytes]]:
    """Send bytes on a connection; return status and content of each answer until the service closes it.

    finish: whether to end the sending side after the bytes.
    """
    received = bytearray()
    with socket.create_connection(("127.0.0.1", attacked.port), DEADLINE) as made, suppress(ConnectionError):
        made.sendall(data)
        if finish:
            made.shutdown(socket.SHUT_WR)
        while piece := made.recv(1 << 16):
            received += piece
    answers = []
    while received:
        head, _, rest = bytes(received).partition(b"\r\n\r\n")
        length = next((int(line[15:]) for line in head.lower().split(b"\r\n") if line[:15] == b"content-length:"), None)
        content = rest if length is None else rest[:length]
        answers.append((int(head.split()[1]), content))
        received = bytearray(b"" if length is None else rest[length:])
    for status, content in answers:
        attacked.statuses[status] += 1
        assert is_documented(status, content), (data[:200], status, content[:500])
    return answers


def request(route: Route, headers: bytes, body: bytes) -> bytes:
    """Return a request after which the service closes the connection."""
    line = f"{route.method} {route.path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n".encode()
    return line + headers + b"\r\n" + body


def sized(length: int, kind: str = "application/json") -> bytes:
    """Return the headers of a body."""
    kind += "; boundary=x" if kind == "multipart/form-data" else ""
    return f"content-type: {kind}\r\ncontent-length: {length}\r\n".encode()


def filling(random: Random, size: int) -> bytes:
    """Return a body of this size that is no valid request."""
    inside = max(0, size - len(b'{"unknown": ""}'))
    made = random.choice(
        (
            lambda: b'{"unknown": "' + b"a" * inside + b'"}',
            lambda: b" " * size,
            lambda: b"[" * size,
            lambda: random.randbytes(size),
            lambda: b"1," * (size // 2),
            lambda: b'{"q": [' + b"0," * (size // 2),
        )
    )()
    return made[:size].ljust(size)


def test_sizes_around_each_limit(attacked, routes):
    random = attack_random("sizes")
    limits = body_limits(Settings(max_upload_bytes=300_000, max_request_bytes=100_000))
    for route in routes:
        limit = body_limit(limits, route.path)
        kinds = random.sample(route.kinds, min(3, len(route.kinds))) or ["application/json"]
        for kind in kinds:
            for size in (0, 1, random.randrange(2, 9000), limit - 1, limit, limit + 1):
                if size <= MAX_SENT_BYTES:
                    answers = exchange(attacked, request(route, sized(size, kind), filling(random, size)))
                    assert len(answers) == 1 or size > limit, (route, size)
                    refused = bool(answers) and answers[0][0] == 413
                    assert not refused or size > limit, (route, kind, size, answers)
            announced = exchange(attacked, request(route, sized(limit + 1, kind), b""), finish=not route.kinds)
            if route.kinds and _is_read(route):
                assert [status for status, _ in announced] == [413], (route, kind, announced)
    attacked.check_sound()


def _is_read(route: Route) -> bool:
    """Return whether a route reads its body: it may reject the request for its path before."""
    return "/0" not in route.path and "unknown" not in route.path


def test_wrong_content_types(attacked, routes):
    random = attack_random("types")
    for route in routes:
        for kind in random.sample(TYPES, 6):
            body = filling(random, random.randrange(200))
            answers = exchange(attacked, request(route, sized(len(body), kind), body))
            assert len(answers) == 1, (route, kind)
            if route.kinds == ("application/json",) and kind == "text/plain":
                assert answers[0][0] in (404, 415, 422), (route, answers)
    attacked.check_sound()


def test_bodies_cut_off(attacked, routes):
    """A request whose body has not arrived completely has no effect."""
    random, before = attack_random("cuts"), content_of(attacked)
    for route in routes:
        for kind in route.kinds[:3]:
            body = filling(random, random.randrange(2, 3000))
            cut = body[: random.randrange(len(body))]
            answers = exchange(attacked, request(route, sized(len(body), kind), cut), finish=True)
            assert all(status >= 400 for status, _ in answers), (route, answers)
    assert content_of(attacked) == before
    attacked.check_sound()


@pytest.mark.parametrize("framing", FRAMINGS)
def test_wrong_lengths(attacked, routes, framing):
    """Bytes of a body are never read as another request."""
    headers, body = FRAMINGS[framing]
    smuggled = b"GET /smuggled HTTP/1.1\r\nhost: localhost\r\n\r\n"
    kind = b"content-type: application/json\r\n"
    before = content_of(attacked)
    for route in attack_random(framing).sample(routes, 25):
        for extra in (b"", smuggled):
            answers = exchange(attacked, request(route, kind + headers, body + extra), finish=True)
            assert len(answers) <= 1, (route, answers)
    assert content_of(attacked) == before
    assert "/smuggled" not in attacked.server.log.read_text()
    attacked.check_sound()


def content_of(attacked: AttackedService) -> dict[str, Any]:
    """Return what the service stores."""
    paths = ("datasets", "robots", "jobs", "models", "models/panda-sim/observations", "models/panda-sim/alarms")
    answers = {path: attacked.client.get(f"/v1/{path}") for path in paths}
    assert {answer.status_code for answer in answers.values()} == {200}
    return json.loads(json.dumps({path: answer.json() for path, answer in answers.items()}))

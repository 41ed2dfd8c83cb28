"""Limits of bodies: too large or too slow, whatever the headers announce."""

import asyncio
from unittest.mock import AsyncMock

import pytest
from starlette.exceptions import HTTPException

from service.api.limits.requests import BodyLimit, body_limit, body_limits
from service.foundation.settings import Settings

SOON = 0.05
"""The time limit of a body, in seconds, in tests that exceed it."""
LONG = 60.0


def limit(app, seconds=LONG, bytes_per_s=1e9, max_bytes=100, at_once=100):
    return BodyLimit(app, {"/large": 1000, "*": max_bytes}, seconds, bytes_per_s, at_once)


def scope(path="/", length=None, client="192.0.2.1", method="POST"):
    headers = [] if length is None else [(b"content-length", str(length).encode())]
    return {"type": "http", "method": method, "path": path, "headers": headers, "client": (client, 1)}


def client_sending(*pieces, more=False):
    """Return a client that sends these pieces on demand: bytes, or seconds to wait before the next piece."""
    left = list(pieces)

    async def receive():
        while left:
            piece = left.pop(0)
            if isinstance(piece, bytes):
                return {"type": "http.request", "body": piece, "more_body": more or bool(left)}
            await asyncio.sleep(piece)
        await asyncio.Event().wait()

    return receive


async def read_body(_, receive, __):
    """An application that reads the whole body."""
    while (await receive())["more_body"]:
        pass


def run_middleware(middleware, request, client):
    asyncio.run(middleware(request, client, None))


def refusal(middleware, request, client):
    """Return the error with which a request ends."""
    with pytest.raises(HTTPException) as caught:
        run_middleware(middleware, request, client)
    return caught.value


@pytest.mark.parametrize(("path", "max_bytes"), [("/", 100), ("/large", 1000), ("/large/er", 100)])
def test_max_body_size_depends_on_the_path(path, max_bytes):
    run_middleware(limit(read_body), scope(path, max_bytes), client_sending(bytes(max_bytes)))
    run_middleware(limit(read_body), scope(path), client_sending(bytes(max_bytes - 1), b"x"))
    for length, *pieces in ((max_bytes + 1, b""), ("9" * 5000, b""), (None, bytes(max_bytes), b"x")):
        refused = refusal(limit(read_body), scope(path, length), client_sending(*pieces))
        assert refused.status_code == 413
        assert str(max_bytes) in refused.detail


@pytest.mark.parametrize("method", ["GET", "HEAD"])
def test_body_of_a_request_without_one_is_ignored(method):
    """It reaches no limit, because a long answer may have begun."""
    sent, seen = [bytes(1000), bytes(1000)], []

    async def receive():
        return {"type": "http.request", "body": sent.pop(), "more_body": True} if sent else {"type": "http.disconnect"}

    async def answer(_, receive, __):
        seen.append(await receive())

    run_middleware(limit(answer), scope(length=2000, method=method), receive)
    assert (seen, sent) == ([{"type": "http.disconnect"}], [])


@pytest.mark.parametrize("pieces", [(), (b"a",), (b"a", b"b")], ids=["nothing", "one piece", "two pieces"])
def test_body_that_never_ends_gets_408(pieces):
    refused = refusal(limit(read_body, SOON), scope(), client_sending(*pieces, more=True))
    assert (refused.status_code, refused.headers) == (408, {"Connection": "close"})
    assert f"{len(pieces)} bytes" in refused.detail


def test_trickling_body_gets_408():
    client = client_sending(*[b"x", SOON / 5] * 100, b"x")
    assert refusal(limit(read_body, SOON), scope(), client).status_code == 408


def test_large_body_may_take_longer():
    run_middleware(limit(read_body, SOON, bytes_per_s=1), scope(), client_sending(bytes(90), 3 * SOON, b"x"))


@pytest.mark.slow
def test_time_of_the_application_does_not_count():
    async def slow(_, receive, __):
        while (await receive())["more_body"]:
            await asyncio.sleep(1.1)

    run_middleware(limit(slow, 1.0), scope(), client_sending(b"x", 0.4, b"y"))


def test_waiting_for_the_disconnect_has_no_limit():
    async def events(_, receive, __):
        await receive()
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(receive(), 3 * SOON)

    run_middleware(limit(events, SOON), scope(), client_sending(b"x"))


@pytest.mark.anyio
async def test_cancelled_request_gets_no_answer():
    task = asyncio.create_task(limit(read_body)(scope(), client_sending(), None))
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task


@pytest.mark.anyio
async def test_concurrent_bodies_have_their_own_deadlines():
    middleware = limit(read_body, SOON, bytes_per_s=100)
    clients = client_sending(), client_sending(bytes(50), SOON * 3, b"x")
    answers = (middleware(scope(), each, None) for each in clients)
    late, in_time = await asyncio.gather(*answers, return_exceptions=True)
    assert isinstance(late, HTTPException)
    assert in_time is None


@pytest.mark.parametrize("kind", ["websocket", "lifespan"])
def test_streams_and_lifespan_are_not_limited(kind):
    app = AsyncMock()
    run_middleware(limit(app), {"type": kind}, None)
    app.assert_awaited_once_with({"type": kind}, None, None)


@pytest.mark.anyio
async def test_concurrent_bodies_of_a_client_are_limited():
    middleware, sent = limit(read_body, at_once=2), asyncio.Event()

    async def slow():
        await sent.wait()
        return {"type": "http.request", "body": b"x", "more_body": False}

    waiting = [asyncio.create_task(middleware(scope(), slow, None)) for _ in range(2)]
    await asyncio.sleep(0)
    with pytest.raises(HTTPException, match=r"bodies from 192.0.2.1 at the same time: at most 2\.") as refused:
        await middleware(scope(), client_sending(b"x"), None)
    assert (refused.value.status_code, refused.value.headers["Retry-After"]) == (429, "1")
    await middleware(scope(client="192.0.2.2"), client_sending(b"x"), None)  # another client's body is read
    sent.set()
    await asyncio.gather(*waiting)
    await middleware(scope(), client_sending(b"x"), None)


@pytest.mark.parametrize("path", ["/v2/models/arm/infer", "/inference.GRPCInferenceService/ModelInfer"])
def test_inference_has_the_limit_of_the_settings_on_every_transport(path):
    settings = Settings(max_request_bytes=5_000_000)
    assert body_limit(body_limits(settings), path) == 5_000_000
    assert body_limit(body_limits(settings), "/v1/models") < 5_000_000

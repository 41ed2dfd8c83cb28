"""Bodies: too large or too slow, whatever they announce."""

import asyncio
from unittest.mock import AsyncMock

import pytest
from starlette.exceptions import HTTPException

from service.api.limits.requests import BodyLimit

SOON = 0.05
"""Seconds that a body may take where it is meant to take too long."""
LONG = 60.0


def limit(app, seconds=LONG, bytes_per_s=1e9, most=100, at_once=100):
    return BodyLimit(app, {"/large": 1000, "*": most}, seconds, bytes_per_s, at_once)


def scope(path="/", length=None, client="192.0.2.1"):
    headers = [] if length is None else [(b"content-length", str(length).encode())]
    return {"type": "http", "path": path, "headers": headers, "client": (client, 1)}


def coming(*pieces, more=False):
    """A client that sends these pieces, each when it is asked for: bytes, or seconds to wait before the next."""
    left = list(pieces)

    async def receive():
        while left:
            piece = left.pop(0)
            if isinstance(piece, bytes):
                return {"type": "http.request", "body": piece, "more_body": more or bool(left)}
            await asyncio.sleep(piece)
        await asyncio.Event().wait()

    return receive


async def reads(_, receive, __):
    """An application that reads the whole body."""
    while (await receive())["more_body"]:
        pass


def served(middleware, request, client):
    asyncio.run(middleware(request, client, None))


@pytest.mark.parametrize(("path", "most"), [("/", 100), ("/large", 1000), ("/large/er", 100)])
def test_a_body_has_a_largest_size_that_depends_on_the_path(path, most):
    served(limit(reads), scope(path, most), coming(bytes(most)))
    served(limit(reads), scope(path), coming(bytes(most - 1), b"x"))
    with pytest.raises(HTTPException) as announced:
        served(limit(reads), scope(path, most + 1), coming(b""))
    with pytest.raises(HTTPException) as digits:
        served(limit(reads), scope(path, "9" * 5000), coming(b""))
    with pytest.raises(HTTPException) as counted:
        served(limit(reads), scope(path), coming(bytes(most), b"x"))
    for caught in (announced, digits, counted):
        assert caught.value.status_code == 413
        assert str(most) in caught.value.detail


@pytest.mark.parametrize("pieces", [(), (b"a",), (b"a", b"b")], ids=["nothing", "one piece", "two pieces"])
def test_a_body_that_never_ends_is_answered_408(pieces):
    with pytest.raises(HTTPException) as caught:
        served(limit(reads, SOON), scope(), coming(*pieces, more=True))
    assert caught.value.status_code == 408
    assert f"{len(pieces)} bytes" in caught.value.detail
    assert caught.value.headers == {"Connection": "close"}


def test_a_body_that_trickles_is_answered_408_though_each_piece_comes_soon():
    with pytest.raises(HTTPException) as caught:
        served(limit(reads, SOON), scope(), coming(*[b"x", SOON / 5] * 100, b"x"))
    assert caught.value.status_code == 408


def test_a_body_may_take_the_time_that_its_size_allows():
    served(limit(reads, SOON, bytes_per_s=1), scope(), coming(bytes(90), 3 * SOON, b"x"))


def test_what_the_application_does_between_two_pieces_does_not_count():
    async def slow(_, receive, __):
        while (await receive())["more_body"]:
            await asyncio.sleep(1.1)

    served(limit(slow, 1.0), scope(), coming(b"x", 0.4, b"y"))


def test_who_waits_for_the_client_to_go_away_may_wait():
    async def events(_, receive, __):
        await receive()
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(receive(), 3 * SOON)

    served(limit(events, SOON), scope(), coming(b"x"))


def test_a_request_that_is_cancelled_is_not_answered():
    async def cancelled():
        task = asyncio.create_task(limit(reads)(scope(), coming(), None))
        await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(cancelled())


def test_bodies_that_wait_at_the_same_time_end_each_at_its_own():
    middleware = limit(reads, SOON, bytes_per_s=100)

    async def both():
        return await asyncio.gather(
            middleware(scope(), coming(), None),
            middleware(scope(), coming(bytes(50), SOON * 3, b"x"), None),
            return_exceptions=True,
        )

    late, in_time = asyncio.run(both())
    assert isinstance(late, HTTPException)
    assert in_time is None


@pytest.mark.parametrize("kind", ["websocket", "lifespan"])
def test_streams_and_the_start_pass(kind):
    app = AsyncMock()
    served(limit(app), {"type": kind}, None)
    app.assert_awaited_once_with({"type": kind}, None, None)


def test_of_one_client_so_many_bodies_are_waited_for_at_a_time():
    middleware, sent = limit(reads, at_once=2), asyncio.Event()

    async def slow():
        await sent.wait()
        return {"type": "http.request", "body": b"x", "more_body": False}

    async def run():
        waiting = [asyncio.ensure_future(middleware(scope(), slow, None)) for _ in range(2)]
        await asyncio.sleep(0)
        with pytest.raises(HTTPException) as refused:
            await middleware(scope(), coming(b"x"), None)
        await middleware(scope(client="192.0.2.2"), coming(b"x"), None)  # another one's is taken
        sent.set()
        await asyncio.gather(*waiting)
        await middleware(scope(), coming(b"x"), None)
        return refused.value

    refusal = asyncio.run(run())
    assert (refusal.status_code, refusal.headers["Retry-After"]) == (429, "1")
    assert "2 bodies of 192.0.2.1" in refusal.detail

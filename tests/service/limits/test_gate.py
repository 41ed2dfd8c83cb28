"""How many requests are answered at a time."""

from __future__ import annotations

import asyncio
import json

import pytest

from service.web.limits.requests import Gate


class Client:
    """What an application sends."""

    def __init__(self) -> None:
        self.sent = []

    async def send(self, message):
        self.sent.append(message)

    @property
    def status(self):
        return self.sent[0]["status"]

    @property
    def headers(self):
        return dict(self.sent[0]["headers"])


def scope(path="/v1/models", kind="http"):
    return {"type": kind, "path": path, "headers": []}


@pytest.fixture
def held():
    """A gate for two, before an application that answers once it may."""
    go = asyncio.Event()

    async def app(_, __, send):
        await go.wait()
        await send({"type": "http.response.start", "status": 200, "headers": []})

    return Gate(app, 2), go


def test_more_requests_than_allowed_are_refused_until_one_ends(held):
    gate, go = held

    async def talk():
        first, second, third, fourth = (Client() for _ in range(4))
        tasks = [asyncio.create_task(gate(scope(), None, each.send)) for each in (first, second)]
        await asyncio.sleep(0)
        await gate(scope(), None, third.send)
        go.set()
        await asyncio.gather(*tasks)
        await gate(scope(), None, fourth.send)
        assert (first.status, second.status, third.status, fourth.status) == (200, 200, 429, 200)
        assert third.headers[b"retry-after"] == b"1"
        assert json.loads(third.sent[1]["body"])["error"]["code"] == "busy"
        assert gate.open == 0

    asyncio.run(talk())


@pytest.mark.parametrize("other", [scope("/health/live"), scope("/v1/echo/stream", "websocket"), scope("", "lifespan")])
def test_health_and_streams_pass_a_gate_that_is_full(held, other):
    gate, go = held

    async def talk():
        tasks = [asyncio.create_task(gate(scope(), None, Client().send)) for _ in range(2)]
        await asyncio.sleep(0)
        client = Client()
        passed = asyncio.create_task(gate(other, None, client.send))
        await asyncio.sleep(0)
        go.set()
        await asyncio.gather(passed, *tasks)
        assert client.status == 200

    asyncio.run(talk())


def test_a_request_that_fails_leaves_its_place():
    async def app(*_):
        raise ZeroDivisionError

    gate = Gate(app, 1)
    for _ in range(3):
        with pytest.raises(ZeroDivisionError):
            asyncio.run(gate(scope(), None, None))
    assert gate.open == 0

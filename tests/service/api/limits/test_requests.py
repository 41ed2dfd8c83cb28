"""The limit of concurrent requests."""

import asyncio
import json
from unittest.mock import AsyncMock

import pytest

from service.api.access.middleware import KEY_ID, KeyAccess
from service.api.limits.rates import RateLimit
from service.api.limits.requests import BodyLimit, Gate, client_of
from service.app import create_app
from service.foundation.settings import Settings

pytestmark = pytest.mark.anyio
MODELS, STREAM = "/v1/models", "/v1/echo/stream"


async def call(middleware, path=MODELS, kind="http"):
    """Call a middleware; return the messages of the answer."""
    send, receive = AsyncMock(), AsyncMock(return_value={"type": "websocket.connect"})
    await middleware({"type": kind, "path": path, "headers": [], "client": ("10.0.0.1", 1)}, receive, send)
    return [each.args[0] for each in send.await_args_list]


async def succeed(_, __, send):
    """An application that answers."""
    await send({"type": "http.response.start", "status": 200, "headers": []})


def error_of(sent, status):
    """Return headers and error of a rejected request."""
    assert sent[0]["status"] == status
    return dict(sent[0]["headers"]), json.loads(sent[-1]["body"])["error"]


@pytest.mark.parametrize(
    ("path", "kind"), [("/health/live", "http"), (STREAM, "websocket"), ("", "lifespan")], ids=["health", "ws", "start"]
)
async def test_full_gate_rejects_requests_but_not_health_or_streams(path, kind):
    go = asyncio.Event()

    async def app(*arguments):
        await go.wait()
        await succeed(*arguments)

    gate = Gate(app, 2)
    tasks = [asyncio.create_task(call(gate)) for _ in range(2)]
    await asyncio.sleep(0)
    headers, error = error_of(await call(gate), 429)
    assert (headers[b"retry-after"], error["code"]) == (b"1", "busy")
    tasks.append(asyncio.create_task(call(gate, path, kind)))
    await asyncio.sleep(0)
    go.set()
    answers = [*await asyncio.gather(*tasks), await call(gate)]
    assert [sent[0]["status"] for sent in answers] == [200] * 4
    assert gate.admitted.total == 0


async def test_failed_request_frees_its_place():
    gate = Gate(AsyncMock(side_effect=ZeroDivisionError), 1)
    for _ in range(3):
        with pytest.raises(ZeroDivisionError):
            await call(gate)
    assert gate.admitted.total == 0


@pytest.mark.parametrize(
    ("client", "expected"),
    [
        (("10.1.2.3", 5000), "10.1.2.3"),
        (("::ffff:10.1.2.3", 5000), "10.1.2.3"),
        (("2001:db8:1:2:3:4:5:6", 1), "2001:db8:1:2::/64"),
        (("fe80::1%eth0", 1), "fe80::/64"),
        (("odd:name", 1), "odd:name"),
        (("", 0), "a local socket"),
        (None, "a local socket"),
    ],
)
def test_client_is_identified_by_key_or_address(client, expected):
    assert client_of({"client": client}) == expected
    assert client_of({"client": client, KEY_ID: "key_1"}) == "API key key_1"


def test_middlewares_are_in_order(home):
    """Keys are checked before their requests are counted, and requests are counted before bodies are read."""
    limits = (Gate, KeyAccess, RateLimit, BodyLimit)
    app = create_app(Settings(home=home, max_requests_per_s=5.0, keys="on"))
    assert [each.cls for each in app.user_middleware if each.cls in limits] == [*limits]
    assert RateLimit not in [each.cls for each in create_app(Settings(home=home)).user_middleware]

"""How often a client may ask."""

from __future__ import annotations

import asyncio
import json

import pytest

from service.app import create_app
from service.foundation.settings import Settings
from service.web.access.middleware import KEY_ID, KeyAccess
from service.web.limits.requests import OTHERS, BodyLimit, Gate, Rate, RateLimit, client_of


def test_a_bucket_holds_a_burst_and_fills_at_the_rate():
    rate = Rate(per_s=10, burst=3)
    assert [rate.wait("a", 0.0) for _ in range(5)] == [0, 0, 0, pytest.approx(0.1), pytest.approx(0.1)]
    assert rate.wait("a", 0.05) == pytest.approx(0.05)
    assert rate.wait("a", 0.1) == 0
    assert rate.wait("a", 0.1) == pytest.approx(0.1)
    assert [rate.wait("a", 100.0) for _ in range(4)] == [0, 0, 0, pytest.approx(0.1)]


def test_over_a_long_time_the_rate_is_what_passes():
    rate = Rate(per_s=7, burst=2)
    passed = sum(rate.wait("a", tick / 100) == 0 for tick in range(10_000))
    assert passed == pytest.approx(7 * 100 + 2, abs=1)


def test_clients_do_not_share_a_rate():
    rate = Rate(per_s=1, burst=1)
    assert (rate.wait("a", 0), rate.wait("b", 0)) == (0, 0)
    assert rate.wait("a", 0) > 0


def test_clients_beyond_the_most_share_one_and_old_ones_are_forgotten():
    rate = Rate(per_s=1, burst=1, most=3)
    assert [rate.wait(name, 0) for name in "abc"] == [0, 0, 0]
    assert rate.wait("d", 0) == 0
    assert rate.wait("e", 0) == 1
    assert set(rate._full) == {*"abc", OTHERS}
    assert rate.wait("f", 10) == 0
    assert set(rate._full) == {"f"}


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
def test_who_asks(client, expected):
    assert client_of({"client": client}) == expected
    assert client_of({"client": client, KEY_ID: "key_1"}) == "the API key key_1"


def answered(middleware, path, kind="http"):
    """First message of the answer to a request."""
    sent = []

    async def send(message):
        sent.append(message)

    async def receive():
        return {"type": "websocket.connect"}

    request = {"type": kind, "path": path, "headers": [], "client": ("10.0.0.1", 1)}
    asyncio.run(middleware(request, receive, send))
    return sent[0] | {"headers": dict(sent[0]["headers"]), "body": sent[-1].get("body", b"")}


async def fine(_, __, send):
    """An application that answers everything."""
    await send({"type": "http.response.start", "status": 200, "headers": []})


def test_requests_beyond_the_rate_are_answered_429():
    limited = RateLimit(fine, per_s=0.001, burst=2)
    assert [answered(limited, "/v1/models")["status"] for _ in range(2)] == [200, 200]
    refused = answered(limited, "/v1/models")
    assert refused["status"] == 429
    assert 900 < int(refused["headers"][b"retry-after"]) <= 1000
    said = json.loads(refused["body"])["error"]
    assert said["code"] == "rate_limited"
    assert "10.0.0.1 asks more than 0.001 times per s" in said["message"]
    assert isinstance(json.loads(answered(limited, "/v2/models/panda-sim/infer")["body"])["error"], str)
    assert answered(limited, "/v1/echo/stream", "websocket")["status"] == 429
    assert answered(limited, "/health/live")["status"] == 200


@pytest.mark.parametrize("per_s", [None, 5.0])
def test_rates_are_limited_only_where_a_setting_says_so(home, per_s):
    app = create_app(Settings(home=home, max_requests_per_s=per_s))
    assert (RateLimit in [each.cls for each in app.user_middleware]) == (per_s is not None)


def test_what_limits_a_service_stands_in_order(home):
    """The outermost first: what is counted per key comes after keys, and nothing is read before it is counted."""
    app = create_app(Settings(home=home, max_requests_per_s=5.0, keys="on"))
    order = [each.cls for each in app.user_middleware]
    assert [each for each in order if each in (Gate, KeyAccess, RateLimit, BodyLimit)] == [
        Gate,
        KeyAccess,
        RateLimit,
        BodyLimit,
    ]

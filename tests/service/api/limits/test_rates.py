"""The limit of the request rate of a client."""

import os

import pytest

from service.api.limits.rates import Buckets, Rate, RateLimit
from tests.service.api.limits.test_requests import STREAM, call, error_of, succeed

pytestmark = pytest.mark.anyio


def test_bucket_of_a_client_holds_a_burst_and_refills():
    rate = Rate(per_s=10, burst=3)
    assert [rate.wait("a", 0.0) for _ in range(5)] == [0, 0, 0, pytest.approx(0.1), pytest.approx(0.1)]
    assert rate.wait("b", 0.0) == 0
    assert rate.wait("a", 0.05) == pytest.approx(0.05)
    assert [rate.wait("a", 0.1) for _ in range(2)] == [0, pytest.approx(0.1)]
    assert [rate.wait("a", 100.0) for _ in range(4)] == [0, 0, 0, pytest.approx(0.1)]


def test_long_term_rate_is_the_limit():
    rate = Rate(per_s=7, burst=2)
    passed = sum(rate.wait("a", tick / 100) == 0 for tick in range(10_000))
    assert passed == pytest.approx(7 * 100 + 2, abs=1)


def test_clients_beyond_the_max_share_a_bucket():
    rate = Rate(per_s=1, burst=1, buckets=Buckets(3))
    assert [rate.wait(name, 1.0) for name in "abcd"] == [0, 0, 0, 0]
    assert rate.wait("e", 1.0) == 1
    assert [rate.wait(name, 1.5) for name in "abc"] == [0.5, 0.5, 0.5]
    assert [rate.wait(name, 10.0) for name in "efg"] == [0, 0, 0]  # instead of those of "abc", which are full
    assert [rate.wait(name, 10.0) for name in "efgab"] == [1, 1, 1, 0, 1]


def test_clients_up_to_the_max_hardly_share():
    buckets, clients = Buckets(1000), [f"10.0.{n}.{m}" for n in range(5) for m in range(100)]
    rate = Rate(per_s=1, burst=1, buckets=buckets)
    assert sum(rate.wait(client, 1.0) == 0 for client in clients) >= 490
    assert all(rate.wait(client, 1.0) > 0 for client in clients)


def test_processes_share_buckets():
    rate = Rate(per_s=0.01, burst=5)
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        os.write(writing, bytes([sum(rate.wait("a", 1.0) == 0 for _ in range(3))]))
        os._exit(0)
    os.waitpid(child, 0)
    assert os.read(reading, 1) == bytes([3])
    assert [rate.wait("a", 1.0) == 0 for _ in range(4)] == [True, True, False, False]
    for descriptor in (reading, writing):
        os.close(descriptor)


async def test_requests_beyond_the_rate_get_429():
    limited = RateLimit(succeed, per_s=0.001, burst=2)
    assert [(await call(limited))[0]["status"] for _ in range(2)] == [200, 200]
    headers, error = error_of(await call(limited), 429)
    assert 900 < int(headers[b"retry-after"]) <= 1000
    assert error["code"] == "rate_limited"
    assert "Too many requests from 10.0.0.1: at most 0.001 per s" in error["message"]
    assert isinstance(error_of(await call(limited, "/v2/models/panda-sim/infer"), 429)[1], str)
    assert (await call(limited, STREAM, "websocket"))[0]["status"] == 429
    assert (await call(limited, "/health/live"))[0]["status"] == 200

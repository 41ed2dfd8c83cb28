"""A service without keys answers this machine, but not web pages of other sites that its browsers show."""

from __future__ import annotations

import asyncio

import pytest

from service.web.access.middleware import MOST_KNOWN, LocalAccess
from tests.service.access.conftest import bearer
from tests.service.data import error

HERE = [
    "localhost",
    "localhost:8000",
    "LocalHost",
    "localhost.",
    "127.0.0.1",
    "127.0.0.1:65535",
    "127.8.9.1",
    "[::1]:80",
]
ELSEWHERE = [
    "evil.example",
    "evil.example:8000",
    "localhost.evil.example",
    "127.0.0.1.evil.example",
    "evil.localhost.example:127",
    "192.168.1.5:8000",
    "[2001:db8::1]:8000",
    "0.0.0.0:8000",
    "[::1",
    "127.0.0.1@evil.example",
    "::1",
    "2130706433",
]


@pytest.mark.parametrize("host", HERE)
def test_names_of_this_machine(api, host):
    assert api.get("/v1/models", headers={"Host": host}).status_code == 200


@pytest.mark.each_once
@pytest.mark.parametrize("host", ELSEWHERE)
@pytest.mark.parametrize("path", ["/v1/models", "/docs", "/health/live"])
def test_names_that_lead_here_from_elsewhere_are_refused(api, host, path):
    said = error(api.get(path, headers={"Host": host}), 403, "forbidden")
    assert said["detail"][0]["field"] == "host"
    assert "LIPSERVE_KEYS=on" in said["message"]


def test_a_host_is_repeated_readably(api):
    answer = api.get("/v1/models", headers={"Host": b"evil\xe2\x80\xae\x1b[31m"})
    assert error(answer, 403, "forbidden")["detail"][0]["value"].isprintable()


@pytest.mark.each_once
@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "null",
        "",
        "http://localhost:3000",
        "http://127.0.0.1",
        "https://",
        "localhost",
        "http://[",
    ],
)
@pytest.mark.parametrize(
    ("method", "path"), [("POST", "/v1/echo"), ("PUT", "/v1/models/nobody/learning"), ("DELETE", "/v1/models/nobody")]
)
def test_pages_of_other_sites_change_nothing(api, method, path, origin):
    answer = api.request(method, path, headers={"Origin": origin})
    said = error(answer, 403, "forbidden")
    assert "web pages of other sites may not ask" in said["message"]
    assert said["detail"][0]["field"] == "origin"


def test_own_pages_and_programs_may_ask(api):
    for headers in ({}, {"Origin": "http://localhost"}):
        assert api.post("/v1/echo", content=b"1", headers=headers).content == b"1"
    headers = {"Host": "127.0.0.1:8000", "Origin": "http://127.0.0.1:8000"}
    assert api.post("/v1/echo", content=b"1", headers=headers).content == b"1"


def test_what_changes_nothing_is_left_to_browsers(api):
    answer = api.get("/v1/models", headers={"Origin": "http://evil.example"})
    assert answer.status_code == 200
    assert "access-control-allow-origin" not in answer.headers


def test_a_service_with_keys_goes_by_the_key_alone(guarded):
    headers = {**bearer(guarded.secrets["predict"]), "Host": "robot.example.org", "Origin": "https://other.example"}
    assert guarded.api.post("/v1/echo", content=b"1", headers=headers).content == b"1"


def test_ports_that_clients_make_up_fill_no_memory():
    asked = []

    async def app(scope, receive, send):
        asked.append(scope)

    local = LocalAccess(app)

    async def ask():
        for port in range(3 * MOST_KNOWN):
            await local({"type": "http", "method": "GET", "headers": [(b"host", b"localhost:%d" % port)]}, None, None)

    asyncio.run(ask())
    assert len(asked) == 3 * MOST_KNOWN
    assert len(local._known) == MOST_KNOWN

"""The middleware of keys: which requests need none, and events that end with their key."""

import asyncio
from unittest.mock import AsyncMock

import pytest

from service.api.access import keys
from service.api.access.keys import Keyring
from service.api.access.middleware import KEY_ID, MAX_KNOWN_HOSTS, KeyAccess, LocalAccess
from service.app import create_app
from tests.service.api.access.conftest import REFRESH_S, bearer
from tests.service.data import error

HERE = ["localhost:8000", "LocalHost", "localhost.", "127.0.0.1:65535", "127.8.9.1", "[::1]:80"]
ELSEWHERE = ["evil.example:8000", "localhost.evil.example", "127.0.0.1.evil.example", "192.168.1.5", "[2001:db8::1]:80"]
MALFORMED = ["[::1", "127.0.0.1@evil.example", "::1", "2130706433", "0.0.0.0:8000"]
ORIGINS = ["http://evil.example", "null", "", "http://localhost:3000", "http://127.0.0.1", "https://", "localhost"]


@pytest.mark.parametrize("host", HERE)
def test_names_of_this_machine_are_accepted(api, host):
    assert api.get("/v1/models", headers={"Host": host}).status_code == 200


@pytest.mark.each_once
@pytest.mark.parametrize("host", [*ELSEWHERE, *MALFORMED])
@pytest.mark.parametrize("path", ["/v1/models", "/docs", "/health/live"])
def test_other_host_names_are_rejected(api, host, path):
    refusal = error(api.get(path, headers={"Host": host}), 403, "forbidden")
    assert refusal["detail"][0]["field"] == "host"
    assert "LIPSERVE_KEYS=on" in refusal["message"]


def test_host_is_repeated_escaped(api):
    answer = api.get("/v1/models", headers={"Host": b"evil\xe2\x80\xae\x1b[31m"})
    assert error(answer, 403, "forbidden")["detail"][0]["value"].isprintable()


@pytest.mark.each_once
@pytest.mark.parametrize("origin", ORIGINS)
@pytest.mark.parametrize("request_", ["POST /v1/echo", "PUT /v1/models/nobody/learning", "DELETE /v1/models/nobody"])
def test_pages_of_other_sites_change_nothing(api, request_, origin):
    refusal = error(api.request(*request_.split(), headers={"Origin": origin}), 403, "forbidden")
    assert "web pages of other sites are not allowed" in refusal["message"]
    assert refusal["detail"][0]["field"] == "origin"


def test_own_pages_and_programs_are_accepted(api):
    by_address = {"Host": "127.0.0.1:8000", "Origin": "http://127.0.0.1:8000"}
    for headers in ({}, {"Origin": "http://localhost"}, by_address):
        assert api.post("/v1/echo", content=b"1", headers=headers).content == b"1"


FOREIGN = [
    {"Origin": "http://evil.example"},
    {"Origin": "null"},
    {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "image"},
    {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "empty"},  # a page on another port
    {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "iframe"},
]
"""Headers that browsers send for pages of other sites, which cannot read the answer."""


@pytest.mark.parametrize("headers", FOREIGN, ids=lambda each: " ".join(each.values()))
@pytest.mark.parametrize("path", ["/v1/models", "/v1/models/panda-sim/live", "/v1/models/panda-sim/export", "/metrics"])
def test_requests_of_other_sites_are_rejected(api, path, headers):
    refusal = error(api.get(path, headers=headers), 403, "forbidden")
    assert refusal["detail"][0]["field"] == "origin"


def test_links_and_own_pages_are_followed(api):
    link = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}
    own = {"Sec-Fetch-Site": "same-origin", "Sec-Fetch-Mode": "cors", "Sec-Fetch-Dest": "empty"}
    for headers in (link, own, {"Sec-Fetch-Site": "none", "Sec-Fetch-Mode": "navigate"}):
        answer = api.get("/", headers=headers)
        assert answer.status_code == 200
        assert "access-control-allow-origin" not in answer.headers
    error(api.post("/v1/echo", content=b"1", headers=link), 403, "forbidden")


def test_service_with_keys_checks_the_key_alone(keyed_service):
    elsewhere = {"Host": "robot.example.org", "Origin": "https://other.example"}
    headers = bearer(keyed_service.secrets["predict"]) | elsewhere
    assert keyed_service.api.post("/v1/echo", content=b"1", headers=headers).content == b"1"


def test_invented_ports_fill_no_memory():
    app = AsyncMock()
    local = LocalAccess(app)

    async def send_requests():
        for port in range(3 * MAX_KNOWN_HOSTS):
            await local({"type": "http", "method": "GET", "headers": [(b"host", b"localhost:%d" % port)]}, None, None)

    asyncio.run(send_requests())
    assert app.await_count == 3 * MAX_KNOWN_HOSTS
    assert len(local._known) == MAX_KNOWN_HOSTS


EVENTS = {"type": "http", "method": "GET", "path": "/v1/jobs/job_1/events", "query_string": b""}


def events(database, app, revoked=None):
    """Request events of an application; return the sent messages and the ASGI scope."""
    row, secret = keys.create(database, "test", ["read"], None)
    headers = [(b"authorization", b"Bearer " + secret.encode())]
    scope = EVENTS | {"headers": headers, "app": create_app()}
    sent = []

    async def send(message):
        sent.append(message)
        if revoked == len(sent):
            keys.revoke(database, row.id)

    async def run():
        keyring = Keyring(REFRESH_S, 10)
        async with keyring.watching(database), asyncio.timeout(30):
            if revoked == 0:
                keys.revoke(database, row.id)
            await KeyAccess(app, keyring)(scope, never, send)

    asyncio.run(run())
    assert scope[KEY_ID] == row.id
    return sent


async def never(*_):
    """Wait for ever."""
    await asyncio.Event().wait()


async def endless(scope, receive, send):
    """Send an event from time to time, for ever."""
    await send({"type": "http.response.start", "status": 200, "headers": []})
    while True:
        await send({"type": "http.response.body", "body": b": alive\n\n", "more_body": True})
        await asyncio.sleep(REFRESH_S / 10)


def test_events_end_with_their_key(keys_database):
    sent = events(keys_database, endless, revoked=3)
    assert sent[0]["status"] == 200
    assert len(sent) > 3
    assert sent[-1] == {"type": "http.response.body", "body": b"", "more_body": False}


def test_revoked_key_rejects_events_that_have_not_begun(keys_database):
    start, body = events(keys_database, never, revoked=0)
    assert start["status"] == 401
    assert b"is no longer valid" in body["body"]


def test_end_and_errors_of_events_are_passed_on(keys_database):
    async def short(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": []})

    assert len(events(keys_database, short)) == 1
    with pytest.raises(OSError, match="the client is gone"):
        events(keys_database, AsyncMock(side_effect=OSError("the client is gone")))

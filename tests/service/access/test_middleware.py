"""The middleware by itself, around applications that no route is: events that last, a stream that cannot start."""

from __future__ import annotations

import asyncio

import pytest

from service.web.access import keys
from service.web.access.keys import Keyring
from service.web.access.middleware import KEY_ID, KeyAccess
from tests.service.access.conftest import REFRESH_S

EVENTS = "/v1/jobs/job_1/events"


def events(database, app, scope_of_key="read", revoked=None):
    """Ask for events of an application; return what was sent, and the ASGI scope."""
    row, secret = keys.create(database, "test", [scope_of_key], None)
    headers = [(b"authorization", b"Bearer " + secret.encode())]
    scope = {"type": "http", "method": "GET", "path": EVENTS, "query_string": b"", "headers": headers}
    sent = []

    async def send(message):
        sent.append(message)
        if revoked == len(sent):
            keys.revoke(database, row.id)

    async def receive():
        await asyncio.Event().wait()

    async def run():
        keyring = Keyring(REFRESH_S)
        async with keyring.watching(database), asyncio.timeout(30):
            if revoked == 0:
                keys.revoke(database, row.id)
            await KeyAccess(app, keyring)(scope, receive, send)

    asyncio.run(run())
    assert scope[KEY_ID] == row.id
    return sent


async def endless(scope, receive, send):
    """Send an event now and then."""
    await send({"type": "http.response.start", "status": 200, "headers": []})
    while True:
        await send({"type": "http.response.body", "body": b": alive\n\n", "more_body": True})
        await asyncio.sleep(REFRESH_S / 10)


async def silent(scope, receive, send):
    """Never begin to answer."""
    await asyncio.Event().wait()


async def short(scope, receive, send):
    """Send one event and end."""
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"data: 1\n\n", "more_body": False})


def test_events_end_with_their_key(keys_database):
    sent = events(keys_database, endless, revoked=3)
    assert sent[0]["status"] == 200
    assert len(sent) > 3
    assert sent[-1] == {"type": "http.response.body", "body": b"", "more_body": False}


def test_events_that_have_not_begun_are_refused(keys_database):
    start, body = events(keys_database, silent, revoked=0)
    assert start["status"] == 401
    assert b"is no longer valid" in body["body"]


def test_events_that_end_by_themselves_are_left_alone(keys_database):
    assert [message.get("body") for message in events(keys_database, short)] == [None, b"data: 1\n\n"]


def test_errors_of_events_are_passed_on(keys_database):
    async def broken(scope, receive, send):
        raise OSError("the client is gone")

    with pytest.raises(OSError, match="the client is gone"):
        events(keys_database, broken)


def test_events_need_a_key_that_may_read(keys_database):
    start, _ = events(keys_database, endless, scope_of_key="predict")
    assert start["status"] == 403

"""Keys of streams: a real server, and clients that a controller, a browser and an intruder would be."""

import json
import re

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from lipserve import Client, StreamClient, StreamError
from service.api.access import keys
from service.foundation.settings import Settings
from service.storage.database import Database
from tests.service.access.conftest import bearer
from tests.service.data import eventually
from tests.service.server import Server
from tests.service.streams import ask, dial, frame, hello

PANDA, ECHO = "/v1/models/panda-sim/stream", "/v1/echo/stream"
MOTION = np.zeros((3, 7))


@pytest.fixture(scope="module")
def locked(tmp_path_factory):
    """A server that asks for keys."""
    settings = {"LIPSERVE_KEYS": "on", "LIPSERVE_LOG_LEVEL": "debug"}
    with Server(
        tmp_path_factory.mktemp("locked"), warm=True, constants={"service.app.REFRESH_S": 0.05}, **settings
    ) as started:
        yield started


@pytest.fixture(scope="module")
def make(locked):
    """Make a key of a server as the CLI does, and wait until it is known; return id and key."""
    database = Database.of(Settings(home=locked.home))

    def made(*scopes):
        row, secret = keys.create(database, "test", scopes, None)
        eventually(lambda: "not one of this service" not in locked.client.get("/v2", headers=bearer(secret)).text)
        return row.id, secret

    made.database = database
    yield made
    database.close()


def refused(server, path, **options):
    """Status and message of a stream that is not opened."""
    with pytest.raises(InvalidStatus) as caught, dial(server, path, **options):
        pass
    response = caught.value.response
    return response.status_code, json.loads(response.body)["error"]["message"]


def with_key(secret):
    return {"additional_headers": bearer(secret)}


def test_a_stream_needs_a_key_that_may_ask(locked, make):
    assert refused(locked, PANDA)[0] == 401
    assert refused(locked, PANDA, **with_key("lip_wrong"))[0] == 401
    status, message = refused(locked, PANDA, **with_key(make("read", "update", "train")[1]))
    assert (status, "this needs predict" in message) == (403, True)
    _, secret = make("predict")
    for path in (PANDA, PANDA + "?std=1"):
        with dial(locked, path, **with_key(secret)) as connection:
            assert hello(connection)["model"] == "panda-sim"
            assert ask(connection, frame(MOTION)).tau.shape == (7,)
    with dial(locked, ECHO, **with_key(secret)) as connection:
        connection.send(b"abc")
        assert connection.recv() == b"abc"


def test_a_stream_that_teaches_needs_a_key_that_may_update(locked, make):
    for path in (PANDA + "?stream_id=arm-1", PANDA + "?std=1&stream%5Fid=arm-1", PANDA + "?stream_id="):
        status, message = refused(locked, path, **with_key(make("predict")[1]))
        assert (status, "this needs update" in message) == (403, True)
    assert refused(locked, PANDA + "?stream_id=arm-1", **with_key(make("update")[1]))[0] == 403
    with dial(locked, PANDA + "?stream_id=arm-1", **with_key(make("predict", "update")[1])) as connection:
        hello(connection)
        assert ask(connection, frame(MOTION, tau=np.zeros(7))).tau.shape == (7,)


def test_addresses_without_a_stream(locked, make):
    assert refused(locked, "/v1/nothing")[0] == 401
    for scope in ("predict", "admin"):
        assert refused(locked, "/v1/nothing", **with_key(make(scope)[1]))[0] == 404


def test_browsers_give_the_key_as_a_subprotocol(locked, make):
    _, secret = make("predict")
    key = f"lipserve.key.{secret}"
    for offered, agreed in (([key], None), (["lipserve", key], "lipserve"), ([key, "lipserve"], "lipserve")):
        with dial(locked, PANDA, subprotocols=offered, origin="https://robot.example") as connection:
            assert connection.subprotocol == agreed
            assert hello(connection)["model"] == "panda-sim"
    assert refused(locked, PANDA, subprotocols=["lipserve"])[0] == 401
    assert refused(locked, PANDA, subprotocols=["lipserve", "lipserve.key.lip_wrong"])[0] == 401
    with dial(locked, PANDA, subprotocols=["other"], **with_key(secret)) as connection:
        assert connection.subprotocol is None


def test_streams_are_closed_when_their_key_is_revoked(locked, make):
    (key, secret), (_, other) = make("predict", "update"), make("predict")
    with (
        dial(locked, PANDA, **with_key(secret)) as idle,
        dial(locked, PANDA + "?stream_id=arm-2", **with_key(secret)) as busy,
        dial(locked, PANDA, **with_key(other)) as others,
    ):
        for connection in (idle, busy, others):
            hello(connection)
        assert ask(busy, frame(MOTION)).tau.shape == (7,)
        keys.revoke(make.database, key)
        with pytest.raises(ConnectionClosed) as caught:
            eventually(lambda: not ask(busy, frame(MOTION)))  # it goes on asking
        with pytest.raises(ConnectionClosed) as unasked:
            idle.recv()
        for closed in (caught.value, unasked.value):
            assert closed.rcvd.code == 1008
            assert closed.rcvd.reason == f"the API key {key} is no longer valid"
        assert ask(others, frame(MOTION)).tau.shape == (7,)
    assert refused(locked, PANDA, **with_key(secret))[0] == 401


def test_a_client_that_ignores_the_close_is_cut_off(locked, make):
    key, secret = make("predict")
    with dial(locked, ECHO, **with_key(secret)) as connection:
        connection.send(b"abc")
        connection.recv()
        peer = connection.socket.getsockname()[1]
        keys.revoke(make.database, key)
        connection.recv_messages.close()  # reads no more, and so answers no close
        eventually(lambda: not _established(locked.port, peer))


def _established(port, peer):
    """Whether the kernel knows a connection between two ports of this machine that is open on the server's side."""
    with open("/proc/net/tcp") as table:
        rows = [line.split() for line in table.readlines()[1:]]
    connection = (f"0100007F:{port:04X}", f"0100007F:{peer:04X}", "01")
    return any((row[1], row[2], row[3]) == connection for row in rows)


def test_the_python_clients(locked, make, monkeypatch):
    monkeypatch.delenv("LIPSERVE_API_KEY", raising=False)
    with pytest.raises(StreamError) as caught:
        StreamClient("panda-sim", locked.url)
    assert caught.value.code == "unauthorized"
    secret = make("predict", "read")[1]
    with Client(locked.url, key=secret) as client, StreamClient("panda-sim", locked.url, key=secret) as frames:
        np.testing.assert_allclose(frames.predict(*MOTION).tau, client.predict("panda-sim", *MOTION).tau, rtol=1e-9)


def test_keys_are_in_no_log(locked, make):
    _, secret = make("read", "predict")
    locked.client.get("/v1/models", headers=bearer(secret))
    locked.client.get("/v1/models", headers=bearer(secret + "x"))
    with dial(locked, PANDA, subprotocols=["lipserve", f"lipserve.key.{secret}"]) as connection:
        hello(connection)
    log = locked.log.read_text()
    assert "/v1/models" in log
    assert not re.search("lip_[A-Za-z0-9_-]{8}", log)
    assert "Traceback" not in log

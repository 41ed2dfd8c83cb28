"""Keys of streams: a real server with clients that act as a controller, a browser and an intruder."""

import json
import re

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from lipserve import Client, StreamClient, StreamError
from service.api.access import keys
from service.foundation.settings import Settings
from service.storage.database import Database
from tests.service.api.access.conftest import bearer
from tests.service.data import eventually
from tests.service.server import Server
from tests.service.streams import frame, open_stream, read_hello, send_frame

PANDA, ECHO = "/v1/models/panda-sim/stream", "/v1/echo/stream"
MOTION = np.zeros((3, 7))


@pytest.fixture(scope="module")
def keyed_server(tmp_path_factory):
    """A server that requires keys."""
    settings = {"LIPSERVE_KEYS": "on", "LIPSERVE_LOG_LEVEL": "debug"}
    with Server(
        tmp_path_factory.mktemp("locked"), warm=True, constants={"service.app.REFRESH_S": 0.05}, **settings
    ) as started:
        yield started


@pytest.fixture(scope="module")
def make_key(keyed_server):
    """Return a function that makes a key as the CLI does, waits until the server knows it, and returns id and key."""
    database = Database.of(Settings(home=keyed_server.home))

    def made(*scopes):
        row, secret = keys.create(database, "test", scopes, None)
        eventually(lambda: "Unknown API key" not in keyed_server.client.get("/v2", headers=bearer(secret)).text)
        return row.id, secret

    made.database = database
    yield made
    database.close()


def rejected(server, path, **options):
    """Return status and message of a stream that is not opened."""
    with pytest.raises(InvalidStatus) as caught, open_stream(server, path, **options):
        pass
    response = caught.value.response
    return response.status_code, json.loads(response.body)["error"]["message"]


def with_key(secret):
    return {"additional_headers": bearer(secret)}


@pytest.mark.slow
def test_stream_needs_the_scope_predict(keyed_server, make_key):
    assert rejected(keyed_server, PANDA)[0] == 401
    assert rejected(keyed_server, PANDA, **with_key("lip_wrong"))[0] == 401
    status, message = rejected(keyed_server, PANDA, **with_key(make_key("read", "update", "train")[1]))
    assert (status, "lacks the scope predict" in message) == (403, True)
    _, secret = make_key("predict")
    for path in (PANDA, PANDA + "?std=1"):
        with open_stream(keyed_server, path, **with_key(secret)) as connection:
            assert read_hello(connection)["model"] == "panda-sim"
            assert send_frame(connection, frame(MOTION)).tau.shape == (7,)
    with open_stream(keyed_server, ECHO, **with_key(secret)) as connection:
        connection.send(b"abc")
        assert connection.recv() == b"abc"


@pytest.mark.slow
def test_stream_with_learning_needs_the_scope_update(keyed_server, make_key):
    for path in (PANDA + "?stream_id=arm-1", PANDA + "?std=1&stream%5Fid=arm-1", PANDA + "?stream_id="):
        status, message = rejected(keyed_server, path, **with_key(make_key("predict")[1]))
        assert (status, "lacks the scope update" in message) == (403, True)
    assert rejected(keyed_server, PANDA + "?stream_id=arm-1", **with_key(make_key("update")[1]))[0] == 403
    with open_stream(
        keyed_server, PANDA + "?stream_id=arm-1", **with_key(make_key("predict", "update")[1])
    ) as connection:
        read_hello(connection)
        assert send_frame(connection, frame(MOTION, tau=np.zeros(7))).tau.shape == (7,)


def test_addresses_without_a_stream(keyed_server, make_key):
    assert rejected(keyed_server, "/v1/nothing")[0] == 401
    for scope in ("predict", "admin"):
        assert rejected(keyed_server, "/v1/nothing", **with_key(make_key(scope)[1]))[0] == 404


def test_browsers_send_the_key_as_subprotocol(keyed_server, make_key):
    _, secret = make_key("predict")
    key = f"lipserve.key.{secret}"
    for offered, agreed in (([key], None), (["lipserve", key], "lipserve"), ([key, "lipserve"], "lipserve")):
        with open_stream(keyed_server, PANDA, subprotocols=offered, origin="https://robot.example") as connection:
            assert connection.subprotocol == agreed
            assert read_hello(connection)["model"] == "panda-sim"
    assert rejected(keyed_server, PANDA, subprotocols=["lipserve"])[0] == 401
    assert rejected(keyed_server, PANDA, subprotocols=["lipserve", "lipserve.key.lip_wrong"])[0] == 401
    with open_stream(keyed_server, PANDA, subprotocols=["other"], **with_key(secret)) as connection:
        assert connection.subprotocol is None


def test_revoked_key_closes_its_streams(keyed_server, make_key):
    (key, secret), (_, other) = make_key("predict", "update"), make_key("predict")
    with (
        open_stream(keyed_server, PANDA, **with_key(secret)) as idle,
        open_stream(keyed_server, PANDA + "?stream_id=arm-2", **with_key(secret)) as busy,
        open_stream(keyed_server, PANDA, **with_key(other)) as others,
    ):
        for connection in (idle, busy, others):
            read_hello(connection)
        assert send_frame(busy, frame(MOTION)).tau.shape == (7,)
        keys.revoke(make_key.database, key)
        with pytest.raises(ConnectionClosed) as caught:
            eventually(lambda: not send_frame(busy, frame(MOTION)))  # the client continues
        with pytest.raises(ConnectionClosed) as unasked:
            idle.recv()
        for closed in (caught.value, unasked.value):
            assert closed.rcvd.code == 1008
            assert closed.rcvd.reason == f"API key {key} is no longer valid."
        assert send_frame(others, frame(MOTION)).tau.shape == (7,)
    assert rejected(keyed_server, PANDA, **with_key(secret))[0] == 401


def test_client_that_ignores_the_close_is_disconnected(keyed_server, make_key):
    key, secret = make_key("predict")
    with open_stream(keyed_server, ECHO, **with_key(secret)) as connection:
        connection.send(b"abc")
        connection.recv()
        peer = connection.socket.getsockname()[1]
        keys.revoke(make_key.database, key)
        connection.recv_messages.close()  # the client stops reading, so it does not answer the close
        eventually(lambda: not _established(keyed_server.port, peer))


def _established(port, peer):
    """Return whether the kernel has an open connection between two ports of this machine on the server's side."""
    with open("/proc/net/tcp") as table:
        rows = [line.split() for line in table.readlines()[1:]]
    connection = (f"0100007F:{port:04X}", f"0100007F:{peer:04X}", "01")
    return any((row[1], row[2], row[3]) == connection for row in rows)


def test_python_clients_send_their_key(keyed_server, make_key, monkeypatch):
    monkeypatch.delenv("LIPSERVE_API_KEY", raising=False)
    with pytest.raises(StreamError) as caught:
        StreamClient("panda-sim", keyed_server.url)
    assert caught.value.code == "unauthorized"
    secret = make_key("predict", "read")[1]
    with (
        Client(keyed_server.url, key=secret) as client,
        StreamClient("panda-sim", keyed_server.url, key=secret) as frames,
    ):
        np.testing.assert_allclose(frames.predict(*MOTION).tau, client.predict("panda-sim", *MOTION).tau, rtol=1e-9)


def test_keys_are_in_no_log(keyed_server, make_key):
    _, secret = make_key("read", "predict")
    keyed_server.client.get("/v1/models", headers=bearer(secret))
    keyed_server.client.get("/v1/models", headers=bearer(secret + "x"))
    with open_stream(keyed_server, PANDA, subprotocols=["lipserve", f"lipserve.key.{secret}"]) as connection:
        read_hello(connection)
    log = keyed_server.log.read_text()
    assert "/v1/models" in log
    assert not re.search("lip_[A-Za-z0-9_-]{8}", log)
    assert "Traceback" not in log

"""Keys of streams: a real server with clients that act as a controller, a browser and an intruder."""

import json
import re
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from lipserve import Client, StreamClient, StreamError
from service.api.access import keys
from service.foundation.settings import Settings
from service.storage.database import Database
from tests.service.api.access.conftest import REFRESH_S, KeyedService, bearer
from tests.service.data import eventually
from tests.service.server import Server
from tests.service.streams import frame, open_stream, read_hello, send_frame

PANDA, ECHO = "/v1/models/panda-sim/stream", "/v1/echo/stream"
MOTION = np.zeros((3, 7))


@pytest.fixture(scope="module")
def keyed_server(tmp_path_factory):
    """A server that requires keys."""
    settings = {"LIPSERVE_KEYS": "on", "LIPSERVE_LOG_LEVEL": "debug"}
    constants = {"service.app.REFRESH_S": REFRESH_S}
    with Server(tmp_path_factory.mktemp("locked"), warm=True, constants=constants, **settings) as started:
        yield started


@pytest.fixture(scope="module")
def service(keyed_server):
    """The same server, to make keys as the CLI does."""
    with closing(Database.of(Settings(home=keyed_server.home))) as database:
        yield KeyedService(keyed_server.client, {}, database)


def open_with(server, path, secret, **options):
    """Return a connection, to be entered, that sends a key."""
    return open_stream(server, path, additional_headers=bearer(secret) if secret else {}, **options)


def rejected(server, path, secret="", **options):
    """Return status and message of a stream that is not opened."""
    with pytest.raises(InvalidStatus) as caught, open_with(server, path, secret, **options):
        pass
    response = caught.value.response
    return response.status_code, json.loads(response.body)["error"]["message"]


@pytest.mark.slow
def test_stream_needs_the_scope_predict(keyed_server, service):
    assert rejected(keyed_server, PANDA)[0] == 401
    assert rejected(keyed_server, PANDA, "lip_wrong")[0] == 401
    status, message = rejected(keyed_server, PANDA, service.make("read", "update", "train")[1])
    assert (status, "lacks the scope predict" in message) == (403, True)
    _, secret = service.make("predict")
    for path in (PANDA, PANDA + "?std=1"):
        with open_with(keyed_server, path, secret) as connection:
            assert read_hello(connection)["model"] == "panda-sim"
            assert send_frame(connection, frame(MOTION)).tau.shape == (7,)
    with open_with(keyed_server, ECHO, secret) as connection:
        connection.send(b"abc")
        assert connection.recv() == b"abc"


@pytest.mark.slow
def test_stream_with_learning_needs_the_scope_update(keyed_server, service):
    for path in (PANDA + "?stream_id=arm-1", PANDA + "?std=1&stream%5Fid=arm-1", PANDA + "?stream_id="):
        status, message = rejected(keyed_server, path, service.make("predict")[1])
        assert (status, "lacks the scope update" in message) == (403, True)
    assert rejected(keyed_server, PANDA + "?stream_id=arm-1", service.make("update")[1])[0] == 403
    with open_with(keyed_server, PANDA + "?stream_id=arm-1", service.make("predict", "update")[1]) as connection:
        read_hello(connection)
        assert send_frame(connection, frame(MOTION, tau=np.zeros(7))).tau.shape == (7,)


def test_addresses_without_a_stream(keyed_server, service):
    assert rejected(keyed_server, "/v1/nothing")[0] == 401
    for scope in ("predict", "admin"):
        assert rejected(keyed_server, "/v1/nothing", service.make(scope)[1])[0] == 404


def test_browsers_send_the_key_as_subprotocol(keyed_server, service):
    _, secret = service.make("predict")
    key = f"lipserve.key.{secret}"
    for offered, agreed in (([key], None), (["lipserve", key], "lipserve"), ([key, "lipserve"], "lipserve")):
        with open_stream(keyed_server, PANDA, subprotocols=offered, origin="https://robot.example") as connection:
            assert connection.subprotocol == agreed
            assert read_hello(connection)["model"] == "panda-sim"
    for offered in (["lipserve"], ["lipserve", "lipserve.key.lip_wrong"]):
        assert rejected(keyed_server, PANDA, subprotocols=offered)[0] == 401
    with open_with(keyed_server, PANDA, secret, subprotocols=["other"]) as connection:
        assert connection.subprotocol is None


def test_revoked_key_closes_its_streams(keyed_server, service):
    (key, secret), (_, other) = service.make("predict", "update"), service.make("predict")
    with (
        open_with(keyed_server, PANDA, secret) as idle,
        open_with(keyed_server, PANDA + "?stream_id=arm-2", secret) as busy,
        open_with(keyed_server, PANDA, other) as others,
    ):
        for connection in (idle, busy, others):
            read_hello(connection)
        assert send_frame(busy, frame(MOTION)).tau.shape == (7,)
        keys.revoke(service.database, key)
        with pytest.raises(ConnectionClosed) as caught:
            eventually(lambda: not send_frame(busy, frame(MOTION)))  # the client continues
        with pytest.raises(ConnectionClosed) as unasked:
            idle.recv()
        for closed in (caught.value, unasked.value):
            assert closed.rcvd.code == 1008
            assert closed.rcvd.reason == f"API key {key} is no longer valid."
        assert send_frame(others, frame(MOTION)).tau.shape == (7,)
    assert rejected(keyed_server, PANDA, secret)[0] == 401


def test_client_that_ignores_the_close_is_disconnected(keyed_server, service):
    key, secret = service.make("predict")
    with open_with(keyed_server, ECHO, secret) as connection:
        connection.send(b"abc")
        connection.recv()
        peer = connection.socket.getsockname()[1]
        keys.revoke(service.database, key)
        connection.recv_messages.close()  # the client stops reading, so it does not answer the close
        eventually(lambda: not _established(keyed_server.port, peer))


def _established(port, peer):
    """Return whether the kernel has an open connection between two ports of this machine on the server's side."""
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    return [f"0100007F:{port:04X}", f"0100007F:{peer:04X}", "01"] in [row[1:4] for row in rows]


def test_python_clients_send_their_key(keyed_server, service, monkeypatch):
    monkeypatch.delenv("LIPSERVE_API_KEY", raising=False)
    with pytest.raises(StreamError) as caught:
        StreamClient("panda-sim", keyed_server.url)
    assert caught.value.code == "unauthorized"
    secret = service.make("predict", "read")[1]
    with (
        Client(keyed_server.url, key=secret) as client,
        StreamClient("panda-sim", keyed_server.url, key=secret) as frames,
    ):
        np.testing.assert_allclose(frames.predict(*MOTION).tau, client.predict("panda-sim", *MOTION).tau, rtol=1e-9)


def test_keys_are_in_no_log(keyed_server, service):
    _, secret = service.make("read", "predict")
    keyed_server.client.get("/v1/models", headers=bearer(secret))
    keyed_server.client.get("/v1/models", headers=bearer(secret + "x"))
    with open_stream(keyed_server, PANDA, subprotocols=["lipserve", f"lipserve.key.{secret}"]) as connection:
        read_hello(connection)
    log = keyed_server.log.read_text()
    assert "/v1/models" in log
    assert not re.search("lip_[A-Za-z0-9_-]{8}", log)
    assert "Traceback" not in log

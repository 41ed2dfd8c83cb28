"""A service that listens for gRPC: its keys, connections, port and shutdown."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack

import grpc
import pytest
from tritonclient.grpc import service_pb2 as published
from tritonclient.grpc.service_pb2_grpc import GRPCInferenceServiceStub

from lipcore.extras import EXTRAS, Extra, MissingExtraError
from service.api.limits.requests import ClientPatience
from service.app import create_app
from service.foundation.settings import Settings
from tests.service.api.oip.grpc import MOTION, PATH, Code, request
from tests.service.api.oip.requests import message
from tests.service.data import DEADLINE
from tests.service.server import Server, free_port

pytestmark = pytest.mark.slow  # needs Triton's client


@pytest.fixture(scope="module")
def keyed_service(tmp_path_factory) -> Iterator[tuple[GRPCInferenceServiceStub, dict[str, str], Server]]:
    """A service with keys and rate limits, and a key of each of two scopes."""
    from service.api.access import keys
    from service.storage.database import Database

    home, port = tmp_path_factory.mktemp("grpc-keys") / "home", free_port()
    settings = {"LIPSERVE_KEYS": "on", "LIPSERVE_MAX_REQUESTS_PER_S": "0.001", "LIPSERVE_MAX_REQUEST_BURST": "4"}
    database = Database.of(Settings(home=home))
    secrets = {scope: keys.create(database, scope, [scope], None)[1] for scope in ("read", "predict")}
    database.close()
    with (
        Server(home, warm=True, LIPSERVE_GRPC_PORT=str(port), **settings) as server,
        grpc.insecure_channel(f"127.0.0.1:{port}") as channel,
    ):
        yield GRPCInferenceServiceStub(channel), secrets, server


def test_keys_scopes_and_rates_are_those_of_http(keyed_service):
    stub, secrets, server = keyed_service
    assert stub.ServerLive(published.ServerLiveRequest(), timeout=DEADLINE).live
    assert stub.ServerReady(published.ServerReadyRequest(), timeout=DEADLINE).ready

    def infer(secret=None):
        metadata = () if secret is None else (("authorization", f"Bearer {secret}"),)
        return stub.ModelInfer(request(MOTION), timeout=DEADLINE, metadata=metadata)

    for secret, code, words in (
        (None, Code.UNAUTHENTICATED, "An API key is required"),
        ("lip_wrong", Code.UNAUTHENTICATED, "Unknown API key."),
        (secrets["read"], Code.PERMISSION_DENIED, "lacks the scope predict"),
    ):
        with pytest.raises(grpc.RpcError) as caught:
            infer(secret)
        assert caught.value.code() == code
        assert words in caught.value.details()
        assert dict(caught.value.trailing_metadata())["www-authenticate"].startswith('Bearer realm="lipserve"')
    headers = {"Authorization": f"Bearer {secrets['predict']}"}
    for _ in range(2):  # gRPC and HTTP share a bucket
        assert len(infer(secrets["predict"]).raw_output_contents) == 2
        assert server.client.post(PATH, json=message(MOTION), headers=headers).status_code == 200
    with pytest.raises(grpc.RpcError, match=r"at most 0.001 per s") as caught:
        infer(secrets["predict"])
    assert caught.value.code() == Code.RESOURCE_EXHAUSTED
    assert int(dict(caught.value.trailing_metadata())["retry-after"]) > 0


def test_stopping_service_ends_its_calls(tmp_path):
    port = free_port()
    with (
        Server(tmp_path / "home", warm=True, LIPSERVE_GRPC_PORT=str(port)) as server,
        grpc.insecure_channel(f"127.0.0.1:{port}") as channel,
    ):
        stub = GRPCInferenceServiceStub(channel)
        assert len(stub.ModelInfer(request(MOTION), timeout=DEADLINE).outputs) == 2
        server.terminate()
        assert "Application shutdown complete" in server.log.read_text()
        with pytest.raises(grpc.RpcError) as caught:
            stub.ModelInfer(request(MOTION), timeout=DEADLINE)
        assert caught.value.code() == Code.UNAVAILABLE


def read_reply(connection: socket.socket) -> bytes:
    """Return what the service sends, empty if it has closed."""
    try:
        return connection.recv(1000)
    except ConnectionResetError:
        return b""


def test_extra_and_silent_connections_are_closed(tmp_path):
    soon = {"service.api.oip.rpc.listening.PATIENCE": ClientPatience(header_s=1.0)}
    port, settings = free_port(), {"LIPSERVE_MAX_CONNECTIONS": "3"}
    server = Server(tmp_path / "home", warm=True, constants=soon, LIPSERVE_GRPC_PORT=str(port), **settings)
    with server, ExitStack() as stack:
        silent = [stack.enter_context(socket.create_connection(("127.0.0.1", port), DEADLINE)) for _ in range(4)]
        assert sum(bool(read_reply(each)) for each in silent) == 3  # an HTTP/2 server sends first
        for each in silent:
            while read_reply(each):  # until the service closes it
                pass
        channel = stack.enter_context(grpc.insecure_channel(f"127.0.0.1:{port}"))
        live = GRPCInferenceServiceStub(channel).ServerLive(
            published.ServerLiveRequest(), timeout=DEADLINE, wait_for_ready=True
        )
        assert live.live


def test_used_port_is_named(tmp_path, keyed_service):
    taken, environment = keyed_service[2].port, {**os.environ, "LIPSERVE_HOME": str(tmp_path / "home")}
    command = [sys.executable, "-m", "service", "serve", "--port", str(free_port()), "--grpc-port", str(taken)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=DEADLINE)
    assert done.returncode == 1
    assert f"error: LIPSERVE_GRPC_PORT is {taken}, expected a free port: Address already in use" in done.stderr
    assert "Traceback" not in done.stderr


def test_missing_extra_is_named_at_the_start(tmp_path, monkeypatch):
    monkeypatch.setitem(EXTRAS, "grpc", Extra("serve over gRPC", ("grpc_that_is_not_there",)))
    with pytest.raises(MissingExtraError, match=r"LIPSERVE_GRPC_PORT is set, which needs .*'lipserve\[grpc\]'"):
        create_app(Settings(home=tmp_path, grpc_port=0))
    create_app(Settings(home=tmp_path))

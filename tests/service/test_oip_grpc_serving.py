"""A service that listens for gRPC: its keys, its connections, its port, and its end."""

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
from tests.service.data import DEADLINE
from tests.service.oip import message
from tests.service.oip_grpc import MOTION, PATH, Code, request
from tests.service.server import Server, free_port


@pytest.fixture(scope="module")
def guarded(tmp_path_factory) -> Iterator[tuple[GRPCInferenceServiceStub, dict[str, str], Server]]:
    """A service that asks for keys and limits rates, and a key of each of two scopes."""
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


def test_keys_scopes_and_rates_are_those_of_http(guarded):
    stub, secrets, server = guarded
    assert stub.ServerLive(published.ServerLiveRequest(), timeout=DEADLINE).live
    assert stub.ServerReady(published.ServerReadyRequest(), timeout=DEADLINE).ready

    def ask(secret=None):
        metadata = () if secret is None else (("authorization", f"Bearer {secret}"),)
        return stub.ModelInfer(request(MOTION), timeout=DEADLINE, metadata=metadata)

    for secret, code, words in (
        (None, Code.UNAUTHENTICATED, "no API key was given"),
        ("lip_wrong", Code.UNAUTHENTICATED, "the API key is not one of this service"),
        (secrets["read"], Code.PERMISSION_DENIED, "this needs predict"),
    ):
        with pytest.raises(grpc.RpcError) as caught:
            ask(secret)
        assert caught.value.code() == code
        assert words in caught.value.details()
        assert dict(caught.value.trailing_metadata())["www-authenticate"].startswith('Bearer realm="lipserve"')
    headers = {"Authorization": f"Bearer {secrets['predict']}"}
    for _ in range(2):  # one bucket for both ways
        assert len(ask(secrets["predict"]).raw_output_contents) == 2
        assert server.client.post(PATH, json=message(MOTION), headers=headers).status_code == 200
    with pytest.raises(grpc.RpcError, match=r"asks more than 0.001 times per s") as caught:
        ask(secrets["predict"])
    assert caught.value.code() == Code.RESOURCE_EXHAUSTED
    assert int(dict(caught.value.trailing_metadata())["retry-after"]) > 0


def test_a_service_that_stops_ends_its_calls(tmp_path):
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


def heard(connection: socket.socket) -> bytes:
    """What a service says, nothing where it has closed."""
    try:
        return connection.recv(1000)
    except ConnectionResetError:
        return b""


def test_connections_beyond_the_most_there_may_be_and_those_that_say_nothing(tmp_path):
    soon = {"service.api.oip.rpc.listening.PATIENCE": ClientPatience(header_s=1.0)}
    port, settings = free_port(), {"LIPSERVE_MAX_CONNECTIONS": "3"}
    server = Server(tmp_path / "home", warm=True, constants=soon, LIPSERVE_GRPC_PORT=str(port), **settings)
    with server, ExitStack() as stack:
        silent = [stack.enter_context(socket.create_connection(("127.0.0.1", port), DEADLINE)) for _ in range(4)]
        assert sum(bool(heard(each)) for each in silent) == 3  # HTTP/2's server speaks first
        for each in silent:
            while heard(each):  # until the service closes it
                pass
        channel = stack.enter_context(grpc.insecure_channel(f"127.0.0.1:{port}"))
        live = GRPCInferenceServiceStub(channel).ServerLive(
            published.ServerLiveRequest(), timeout=DEADLINE, wait_for_ready=True
        )
        assert live.live


def test_a_port_that_is_taken_is_named(tmp_path, guarded):
    taken, environment = guarded[2].port, {**os.environ, "LIPSERVE_HOME": str(tmp_path / "home")}
    command = [sys.executable, "-m", "service", "serve", "--port", str(free_port()), "--grpc-port", str(taken)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=DEADLINE)
    assert done.returncode == 1
    assert f"error: LIPSERVE_GRPC_PORT is {taken}, expected a port that is free: Address already in use" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_missing_extra_is_named_at_the_start(tmp_path, monkeypatch):
    monkeypatch.setitem(EXTRAS, "grpc", Extra("answer over gRPC", ("grpc_that_is_not_there",)))
    with pytest.raises(MissingExtraError, match=r"LIPSERVE_GRPC_PORT is set, which needs .*'lipserve\[grpc\]'"):
        create_app(Settings(home=tmp_path, grpc_port=0))
    create_app(Settings(home=tmp_path))

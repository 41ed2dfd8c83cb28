"""A service that listens for gRPC: its keys, connections, port and shutdown."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from tritonclient.grpc import service_pb2 as published

from lipcore.extras import EXTRAS, Extra, MissingExtraError
from service.api.access import keys
from service.api.limits.requests import ClientPatience
from service.app import create_app
from service.foundation.settings import Settings
from service.storage.database import Database
from tests.service.api.access.conftest import bearer
from tests.service.api.oip.grpc import Code, GrpcService, request, start_service
from tests.service.api.oip.requests import MOTION, PATH, message
from tests.service.data import DEADLINE
from tests.service.server import free_port

pytestmark = pytest.mark.slow  # needs Triton's client


@pytest.fixture(scope="module")
def keyed_service(tmp_path_factory) -> Iterator[tuple[GrpcService, dict[str, str]]]:
    """A service with keys and rate limits, and a key of each of two scopes."""
    home = tmp_path_factory.mktemp("grpc-keys") / "home"
    settings = {"LIPSERVE_KEYS": "on", "LIPSERVE_MAX_REQUESTS_PER_S": "0.001", "LIPSERVE_MAX_REQUEST_BURST": "4"}
    database = Database.of(Settings(home=home))
    secrets = {scope: keys.create(database, scope, [scope], None)[1] for scope in ("read", "predict")}
    database.close()
    with start_service(home, **settings) as service:
        yield service, secrets


def test_keys_scopes_and_rates_are_those_of_http(keyed_service):
    service, secrets = keyed_service
    infer = service.stub.ModelInfer
    assert service.stub.ServerLive(published.ServerLiveRequest(), timeout=DEADLINE).live
    assert service.stub.ServerReady(published.ServerReadyRequest(), timeout=DEADLINE).ready

    def key_options(secret):
        return {"metadata": (("authorization", f"Bearer {secret}"),) if secret else ()}

    for secret, code, words in (
        (None, Code.UNAUTHENTICATED, "An API key is required"),
        ("lip_wrong", Code.UNAUTHENTICATED, "Unknown API key."),
        (secrets["read"], Code.PERMISSION_DENIED, "lacks the scope predict"),
    ):
        error = service.call_error(infer, request(MOTION), **key_options(secret))
        assert error.code() == code
        assert words in error.details()
        assert dict(error.trailing_metadata())["www-authenticate"].startswith('Bearer realm="lipserve"')
    allowed = key_options(secrets["predict"])
    for _ in range(2):  # gRPC and HTTP share a bucket
        assert len(infer(request(MOTION), timeout=DEADLINE, **allowed).raw_output_contents) == 2
        answer = service.server.client.post(PATH, json=message(MOTION), headers=bearer(secrets["predict"]))
        assert answer.status_code == 200
    error = service.call_error(infer, request(MOTION), **allowed)
    assert (error.code(), "at most 0.001 per s" in error.details()) == (Code.RESOURCE_EXHAUSTED, True)
    assert int(dict(error.trailing_metadata())["retry-after"]) > 0


def test_stopping_service_ends_its_calls(tmp_path):
    with start_service(tmp_path / "home") as service:
        assert len(service.stub.ModelInfer(request(MOTION), timeout=DEADLINE).outputs) == 2
        service.server.terminate()
        assert "Application shutdown complete" in service.server.log.read_text()
        assert service.call_error(service.stub.ModelInfer, request(MOTION)).code() == Code.UNAVAILABLE


def read_reply(connection: socket.socket) -> bytes:
    """Return what the service sends, empty if it has closed."""
    try:
        return connection.recv(1000)
    except ConnectionResetError:
        return b""


def test_extra_and_silent_connections_are_closed(tmp_path):
    soon = {"service.api.oip.rpc.listening.PATIENCE": ClientPatience(header_s=1.0)}
    with start_service(tmp_path / "home", soon, LIPSERVE_MAX_CONNECTIONS="3") as service, ExitStack() as stack:
        address = ("127.0.0.1", service.port)
        silent = [stack.enter_context(socket.create_connection(address, DEADLINE)) for _ in range(4)]
        assert sum(bool(read_reply(each)) for each in silent) == 3  # an HTTP/2 server sends first
        for each in silent:
            while read_reply(each):  # until the service closes it
                pass
        request = published.ServerLiveRequest()
        assert service.stub.ServerLive(request, timeout=DEADLINE, wait_for_ready=True).live


def test_used_port_is_named(tmp_path, keyed_service):
    taken, environment = keyed_service[0].server.port, {**os.environ, "LIPSERVE_HOME": str(tmp_path / "home")}
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

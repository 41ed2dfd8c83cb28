"""Limits of torque streams: their number, their memory, idle and unread streams, and shutdown."""

import json
import socket
from contextlib import suppress
from pathlib import Path

import pytest
from websockets.client import ClientProtocol
from websockets.exceptions import InvalidStatus
from websockets.uri import parse_uri

from service.api.limits.requests import ClientPatience
from tests.service.data import DEADLINE, eventually
from tests.service.server import Server
from tests.service.streams import open_stream, read_hello

PANDA, ECHO = "/v1/models/panda-sim/stream", "/v1/echo/stream"
MiB = 1024 * 1024


@pytest.fixture(scope="module")
def bounded(tmp_path_factory):
    """A server with room for two streams that soon closes those that do not read."""
    home = tmp_path_factory.mktemp("bounded")
    soon = {"service.api.stream.session.PATIENCE": ClientPatience(frame_s=1.0)}
    with Server(home, warm=True, constants=soon, LIPSERVE_MAX_STREAMS="2") as started:
        yield started


class NonReadingClient:
    """A client that never reads: WebSocket frames over a bare socket."""

    def __init__(self, server: Server, path: str) -> None:
        self.socket = socket.create_connection(("127.0.0.1", server.port), DEADLINE)
        self.protocol = ClientProtocol(parse_uri(f"ws://127.0.0.1:{server.port}{path}"), max_size=None)
        self.protocol.send_request(self.protocol.connect())
        self.flush()
        while not self.protocol.events_received():
            self.protocol.receive_data(self.socket.recv(4096))
        if self.protocol.handshake_exc is not None:
            raise self.protocol.handshake_exc

    def flush(self) -> int:
        data = b"".join(self.protocol.data_to_send())
        self.socket.sendall(data)
        return len(data)

    def send(self, *messages: bytes) -> int:
        for message in messages:
            self.protocol.send_binary(message)
        return self.flush()


def open_client(server: Server, path: str) -> NonReadingClient | None:
    """Return a client that never reads, None while the server has no room."""
    try:
        return NonReadingClient(server, path)
    except InvalidStatus:
        return None


def resident_bytes(pid: int) -> int:
    """Return the resident memory of a process in bytes."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) * 1024
    raise AssertionError("no VmRSS")


@pytest.mark.slow
def test_extra_streams_are_rejected_until_one_ends(bounded):
    with open_stream(bounded, PANDA) as first, open_stream(bounded, ECHO):
        read_hello(first)
        with pytest.raises(InvalidStatus) as refused, open_stream(bounded, PANDA):
            pass
        response = refused.value.response
        assert response.status_code == 429
        assert json.loads(response.body)["error"]["code"] == "busy"
        assert "Too many streams: 2 are open." in json.loads(response.body)["error"]["message"]

    def another():
        try:
            with open_stream(bounded, PANDA) as connection:
                return read_hello(connection)
        except InvalidStatus:
            return None

    assert eventually(another)["version"] == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "size"),
    [pytest.param(PANDA, 0, id="tiny frames"), pytest.param(ECHO, 60_000, id="large frames", marks=pytest.mark.slow)],
)
def test_client_that_never_reads_is_throttled_and_disconnected(bounded, path, size):
    with open_stream(bounded, ECHO) as other:
        before = resident_bytes(bounded.process.pid)
        unread = eventually(lambda: open_client(bounded, path))
        sent, peak = 0, 0
        with suppress(ConnectionError):
            while sent < 64 * MiB:
                sent += unread.send(*[bytes(size)] * 10)
                peak = max(peak, resident_bytes(bounded.process.pid))
        # more than the buffers of two sockets: the rest would be in the server's memory
        assert sent < 64 * MiB
        assert peak - before < 48 * MiB
        other.send(b"still here")
        assert other.recv(DEADLINE) == b"still here"
    assert "ERROR" not in bounded.log.read_text()

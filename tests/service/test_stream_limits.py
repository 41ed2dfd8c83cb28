"""Bounds of torque streams: connections, memory, idle and unread streams, and a server that stops."""

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
from tests.service.streams import dial, hello

PANDA, ECHO = "/v1/models/panda-sim/stream", "/v1/echo/stream"
MiB = 1024 * 1024


@pytest.fixture(scope="module")
def bounded(tmp_path_factory):
    """A server with room for two streams, which soon gives up those that do not read."""
    home = tmp_path_factory.mktemp("bounded")
    soon = {"service.api.stream.session.PATIENCE": ClientPatience(frame_s=1.0)}
    with Server(home, warm=True, constants=soon, LIPSERVE_MAX_STREAMS="2") as started:
        yield started


class Unread:
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


def opened(server: Server, path: str) -> Unread | None:
    """A client that never reads, None while the server has no room."""
    try:
        return Unread(server, path)
    except InvalidStatus:
        return None


def memory(pid: int) -> int:
    """Resident bytes of a process."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) * 1024
    raise AssertionError("no VmRSS")


def test_more_streams_than_allowed_are_refused_until_one_ends(bounded):
    with dial(bounded, PANDA) as first, dial(bounded, ECHO):
        hello(first)
        with pytest.raises(InvalidStatus) as refused, dial(bounded, PANDA):
            pass
        response = refused.value.response
        assert response.status_code == 429
        assert json.loads(response.body)["error"]["code"] == "busy"
        assert "2 streams are open" in json.loads(response.body)["error"]["message"]

    def another():
        try:
            with dial(bounded, PANDA) as connection:
                return hello(connection)
        except InvalidStatus:
            return None

    assert eventually(another)["version"] == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "size"),
    [pytest.param(PANDA, 0, id="tiny frames"), pytest.param(ECHO, 60_000, id="large frames", marks=pytest.mark.slow)],
)
def test_a_client_that_never_reads_is_slowed_down_and_then_cut_off(bounded, path, size):
    with dial(bounded, ECHO) as other:
        before = memory(bounded.process.pid)
        unread = eventually(lambda: opened(bounded, path))
        sent, most = 0, 0
        with suppress(ConnectionError):
            while sent < 64 * MiB:
                sent += unread.send(*[bytes(size)] * 10)
                most = max(most, memory(bounded.process.pid))
        # the buffers of two sockets, with room to spare: what is sent beyond them would be in the server's memory
        assert sent < 64 * MiB
        assert most - before < 48 * MiB
        other.send(b"still here")
        assert other.recv(DEADLINE) == b"still here"
    assert "ERROR" not in bounded.log.read_text()

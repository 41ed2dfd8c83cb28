"""Limits of torque streams: their number, their memory, idle and unread streams, and shutdown."""

import resource
import struct
from contextlib import suppress
from pathlib import Path

import pytest
from websockets.exceptions import InvalidStatus

from service.api.limits.requests import ClientPatience
from tests.service.api.limits.serving import RawConnection
from tests.service.api.stream.test_answers import refusal
from tests.service.data import DEADLINE, eventually
from tests.service.server import Server
from tests.service.streams import open_stream, read_hello

PANDA, ECHO = "/v1/models/panda-sim/stream", "/v1/echo/stream"
MiB = 1024 * 1024


@pytest.fixture(scope="module")
def bounded(tmp_path_factory):
    """A server with room for two streams that soon closes those that do not read."""
    home = tmp_path_factory.mktemp("bounded")
    soon = {"service.api.stream.conversation.PATIENCE": ClientPatience(frame_s=1.0)}
    with Server(home, warm=True, constants=soon, LIPSERVE_MAX_STREAMS="2") as started:
        yield started


HANDSHAKE = (
    b"GET %b HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)


def open_client(server: Server, path: str) -> RawConnection | None:
    """Return a client that never reads its stream, None while the server has no room."""
    client = RawConnection(server.port)
    client.send(HANDSHAKE % path.encode())
    return client if client.read_exactly(12) == b"HTTP/1.1 101" else None


def zero_message(size: int) -> bytes:
    """Return a binary message of zeros whose mask is zero, too."""
    length = struct.pack(">B", 0x80 | size) if size < 126 else struct.pack(">BH", 0x80 | 126, size)
    return b"\x82" + length + bytes(4 + size)


def resident_bytes(pid: int) -> int:
    """Return the resident memory of a process in bytes."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * resource.getpagesize()


@pytest.mark.slow
def test_extra_streams_are_rejected_until_one_ends(bounded):
    with open_stream(bounded, PANDA) as first, open_stream(bounded, ECHO):
        read_hello(first)
        status, problem = refusal(bounded, PANDA)
        assert (status, problem["code"]) == (429, "busy")
        assert "Too many streams: 2 are open." in problem["message"]

    def another():
        with suppress(InvalidStatus), open_stream(bounded, PANDA) as connection:
            return read_hello(connection)

    assert eventually(another)["version"] == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "size"),
    [pytest.param(PANDA, 0, id="tiny frames"), pytest.param(ECHO, 60_000, id="large frames")],
)
def test_client_that_never_reads_is_throttled_and_disconnected(bounded, path, size):
    with open_stream(bounded, ECHO) as other:
        before = resident_bytes(bounded.process.pid)
        unread = eventually(lambda: open_client(bounded, path))
        messages, sent, peak = zero_message(size) * 10, 0, 0
        with unread, suppress(ConnectionError):
            while sent < 64 * MiB:
                unread.send(messages)
                sent += len(messages)
                peak = max(peak, resident_bytes(bounded.process.pid))
        # more than the buffers of two sockets: the rest would be in the server's memory
        assert sent < 64 * MiB
        assert peak - before < 48 * MiB
        other.send(b"still here")
        assert other.recv(DEADLINE) == b"still here"
    assert "ERROR" not in bounded.log.read_text()

"""Scripted services: one thread, one connection after another, bytes written by hand."""

import json
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from websockets.utils import accept_key, apply_mask

from tests.service.data import DEADLINE

HELLO = {
    "layout": 1, "model": "m", "version": 3, "revision": 0, "joint_names": ["a", "b"],
    "torque_convention": "gravity included", "noise_std": [0.1, 0.2], "max_position": 12.6,
}  # fmt: skip


class Talk:
    """Open connection of a service. Frames of the client are masked, those of the service are not."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection

    def take(self, count: int) -> bytes:
        """Read bytes of the client; raise ConnectionError if it has closed the connection."""
        data = bytearray()
        while len(data) < count:
            part = self.connection.recv(count - len(data))
            if not part:
                raise ConnectionError("the client is gone")
            data += part
        return bytes(data)

    def read(self) -> tuple[int, bytes]:
        """Return opcode and payload of the client's next frame."""
        first, second = self.take(2)
        assert first & 0x80, "a client's message is one frame"
        assert second & 0x80, "a client masks"
        size = second & 127
        if size > 125:
            size = int.from_bytes(self.take(2 if size == 126 else 8), "big")
        mask, payload = self.take(4), self.take(size)
        return first & 15, apply_mask(payload, mask) if payload else b""

    def end(self) -> None:
        """Stop sending and wait until the client closes: closing with unread data would discard sent data."""
        self.connection.shutdown(socket.SHUT_WR)
        while self.connection.recv(1 << 16):
            pass

    def request(self) -> int:
        """Return the sequence of the client's next request."""
        opcode, payload = self.read()
        if opcode == 8:
            raise ConnectionError("the client has closed")
        assert opcode == 2
        return int(struct.unpack_from("<I", payload)[0])

    def send(self, first: int, payload: bytes) -> None:
        """Send a frame: its first byte, and its payload."""
        self.connection.sendall(frame(first, payload))

    def text(self, **message: object) -> None:
        """Send a text message."""
        self.send(0x81, json.dumps(message).encode())

    def answer(self, sequence: int, tau: float = 1.0) -> None:
        """Answer a request of two joints."""
        self.send(0x82, answer(sequence, tau))

    def refuse(self, sequence: int, message: str) -> None:
        """Answer a request with an error."""
        body = json.dumps({"error": {"code": "invalid_request", "message": message, "detail": []}})
        self.send(0x82, struct.pack("<IHHIIQd", sequence, 4, 0, 3, 0, 0, 1e-4) + body.encode())


def frame(first: int, payload: bytes) -> bytes:
    """Return a frame of a service."""
    size = len(payload)
    length = bytes([size]) if size < 126 else struct.pack(">BH" if size < 65536 else ">BQ", 126 + (size > 65535), size)
    return bytes([first]) + length + payload


def answer(sequence: int, tau: float = 1.0) -> bytes:
    """Return an answer of two joints."""
    return struct.pack("<IHHIIQd2d", sequence, 0, 2, 3, 0, 0, 1e-4, tau, -tau)


def head_of(connection: socket.socket) -> bytes:
    """Read the client's HTTP request for a stream."""
    head = b""
    while not head.endswith(b"\r\n\r\n"):
        part = connection.recv(1)
        if not part:
            raise ConnectionError("the client is gone")
        head += part
    return head


def upgraded(connection: socket.socket, key: str | None = None) -> None:
    """Accept a client's request for a stream. key: accept this key instead of the client's."""
    head = head_of(connection)
    given = next(line.split(b": ")[1] for line in head.split(b"\r\n") if line.startswith(b"Sec-WebSocket-Key"))
    accepted = accept_key(key or given.decode())
    lines = (
        "101 Switching Protocols",
        "Upgrade: websocket",
        "Connection: Upgrade",
        f"Sec-WebSocket-Accept: {accepted}",
    )
    connection.sendall(("HTTP/1.1 " + "\r\n".join(lines) + "\r\n\r\n").encode())


def streaming(script: Callable[[Talk], None], **hello: object) -> Callable[[socket.socket], None]:
    """Return a service that opens a stream and then runs a script."""

    def serve(connection: socket.socket) -> None:
        upgraded(connection)
        talk = Talk(connection)
        talk.text(**{**HELLO, **hello})
        script(talk)
        talk.end()

    return serve


@contextmanager
def serving(*services: Callable[[socket.socket], None]) -> Iterator[str]:
    """Yield the address of a service; each connection is served by the next function, then always by the last.

    A failed assertion in a function fails the test.
    """
    failures: list[BaseException] = []
    ended = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setsockopt(
            socket.SOL_SOCKET, socket.SO_RCVBUF, 4096
        )  # small, so that a client must wait if nobody reads

        def accept() -> None:
            for number in range(10**6):
                try:
                    connection, _ = server.accept()
                except OSError:
                    return
                with connection:
                    if ended.is_set():
                        return
                    connection.settimeout(DEADLINE)
                    try:
                        services[min(number, len(services) - 1)](connection)
                    except OSError:
                        pass
                    except BaseException as error:
                        failures.append(error)
                        return

        thread = threading.Thread(target=accept, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.getsockname()[1]}"
        ended.set()
        with suppress(OSError), socket.create_connection(server.getsockname()[:2], DEADLINE):
            pass
        thread.join(DEADLINE)
    assert not failures, failures

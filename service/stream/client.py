"""A synchronous client of torque streams, for controllers on the same host or network."""

from __future__ import annotations

import json
import socket
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.parse import quote, urlencode, urlsplit

import numpy as np
from numpy.typing import ArrayLike, NDArray
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.sync.client import connect

from service.settings import DEFAULT_URL
from service.stream.frames import ANSWER, ASK_STD, ERROR, HAS_STD, LATE, LAYOUT, NUMBER, REQUEST, UNREAD

_SEQUENCES = 1 << 32


class StreamError(RuntimeError):
    """The service refused a connection or a frame, or is gone.

    code: as the service says, else `unreachable`, `closed`, `timeout` or `layout`; detail: its problems; sequence: of
    the frame that was refused, None where it could not be read.
    """

    def __init__(
        self, message: str, code: str, detail: list[dict[str, Any]] | None = None, sequence: int | None = None
    ) -> None:
        super().__init__(message)
        self.message, self.code, self.detail, self.sequence = message, code, detail or [], sequence


@dataclass(frozen=True)
class StreamHello:
    """What holds for all answers of a version. noise_std: (n,) N·m, of the measurement around the function."""

    model: str
    version: int
    revision: int
    joint_names: tuple[str, ...]
    torque_convention: str
    noise_std: NDArray[np.float64]
    max_position: float


@dataclass(frozen=True, slots=True)
class StreamAnswer:
    """Torque at one motion, N·m.

    tau: (n,) mean; tau_std: (n,) standard deviation of the function, where asked for; late: whether the answer left
    the service after its deadline; late_answers: how many of this connection have; seconds: from the arrival of the
    frame in the service to the departure of the answer.
    """

    sequence: int
    tau: NDArray[np.float64]
    tau_std: NDArray[np.float64] | None
    version: int
    revision: int
    late: bool
    late_answers: int
    seconds: float


class StreamClient:
    """One stream; use it as a context manager or close it. Not to be shared between threads.

    model: its name; unix: path of the service's Unix-domain socket, instead of host and port of the address; version:
    pins one, else the newest answers; timeout: longest wait for the connection, and for one answer, in s.
    hello: what the service said of the version that answers.
    Raise StreamError where the service cannot be reached or refuses.
    """

    def __init__(
        self,
        model: str,
        url: str = DEFAULT_URL,
        unix: Path | None = None,
        version: int | None = None,
        timeout: float = 10.0,
    ) -> None:
        self.timeout = timeout
        self._sequence, self._stack = 0, ExitStack()
        parts = urlsplit(url)
        secure = parts.scheme in ("https", "wss")
        query = "" if version is None else "?" + urlencode({"version": version})
        address = f"{'wss' if secure else 'ws'}://{parts.netloc}/v1/models/{quote(model, safe='')}/stream{query}"
        try:
            made = _connect(parts.hostname or "127.0.0.1", parts.port or (443 if secure else 80), unix, timeout)
            self._socket = self._stack.enter_context(
                connect(address, sock=made, compression=None, open_timeout=timeout, close_timeout=1.0)
            )
        except InvalidStatus as error:
            raise _refused(error.response.status_code, error.response.body) from error
        except (OSError, InvalidHandshake) as error:
            raise StreamError(f"no service answers at {unix or url}: {error}", "unreachable") from error
        self.hello = self._hello(self._receive(timeout))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._stack.close()

    def ask(self, q: ArrayLike, dq: ArrayLike, ddq: ArrayLike, std: bool = True, deadline: float = 0.0) -> StreamAnswer:
        """Return the torque at one motion: q, dq, ddq of shape (n,) in SI units.

        deadline: seconds that the service may take before it counts the answer as late; 0 for none.
        Raise StreamError where the service refuses the motion (the stream goes on), is gone, or does not answer in
        time: an answer that comes after all is dropped by the next call.
        """
        sequence = self.send(q, dq, ddq, std, deadline)
        while True:
            try:
                answer = self.receive()
            except StreamError as error:
                if error.sequence is None or error.sequence == sequence:
                    raise
                continue
            if answer.sequence == sequence:
                return answer

    def send(self, q: ArrayLike, dq: ArrayLike, ddq: ArrayLike, std: bool = True, deadline: float = 0.0) -> int:
        """Send one query and return its sequence; its answer comes in turn from `receive`."""
        q, dq, ddq = (np.ascontiguousarray(part, NUMBER) for part in (q, dq, ddq))
        if not q.shape == dq.shape == ddq.shape == (len(q),):
            raise ValueError(f"q, dq and ddq have the shapes {q.shape}, {dq.shape}, {ddq.shape}, expected (n,) each")
        self._sequence = (self._sequence + 1) % _SEQUENCES
        header = REQUEST.pack(self._sequence, ASK_STD if std else 0, len(q), deadline)
        try:
            self._socket.send(b"".join((header, q.tobytes(), dq.tobytes(), ddq.tobytes())))
        except ConnectionClosed as error:
            raise _closed(error) from error
        return self._sequence

    def receive(self) -> StreamAnswer:
        """Return the answer to the oldest query without one; raise StreamError where it was refused."""
        while isinstance(data := self._receive(self.timeout), str):
            self.hello = self._hello(data)
        sequence, flags, n, version, late, revision, seconds = ANSWER.unpack_from(data)
        if flags & ERROR:
            error = json.loads(data[ANSWER.size :])["error"]
            known = None if flags & UNREAD else sequence
            raise StreamError(error["message"], error["code"], error["detail"], known)
        numbers = np.frombuffer(data, NUMBER, offset=ANSWER.size)
        std = numbers[n:] if flags & HAS_STD else None
        return StreamAnswer(sequence, numbers[:n], std, version, revision, bool(flags & LATE), late, seconds)

    def _receive(self, timeout: float) -> str | bytes:
        try:
            return self._socket.recv(timeout)
        except TimeoutError as error:
            raise StreamError(f"no answer within {timeout:g} s", "timeout") from error
        except ConnectionClosed as error:
            raise _closed(error) from error

    def _hello(self, data: str | bytes) -> StreamHello:
        said = json.loads(data)
        if said["layout"] != LAYOUT:
            self.close()
            raise StreamError(
                f"the service's frames have layout {said['layout']}, this client knows {LAYOUT}", "layout"
            )
        return StreamHello(
            model=said["model"],
            version=said["version"],
            revision=said["revision"],
            joint_names=tuple(said["joint_names"]),
            torque_convention=said["torque_convention"],
            noise_std=np.array(said["noise_std"]),
            max_position=said["max_position"],
        )


def _connect(host: str, port: int, unix: Path | None, timeout: float) -> socket.socket:
    """Open a connection without Nagle's delay, and without the proxy that a controller's environment may name."""
    if unix is not None:
        made = socket.socket(socket.AF_UNIX)
        try:
            made.settimeout(timeout)
            made.connect(str(unix))
        except OSError:
            made.close()
            raise
    else:
        made = socket.create_connection((host, port), timeout)
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    made.settimeout(None)
    return made


def _refused(status: int, body: bytes | bytearray) -> StreamError:
    try:
        error = json.loads(body)["error"]
        return StreamError(error["message"], error["code"], error["detail"])
    except (ValueError, KeyError, TypeError):
        return StreamError(f"the service refused the stream with status {status}", "refused")


def _closed(error: ConnectionClosed) -> StreamError:
    if error.rcvd is None:
        return StreamError("the connection is lost", "closed")
    return StreamError(f"the service closed the stream: {error.rcvd.reason or error.rcvd.code}", "closed")

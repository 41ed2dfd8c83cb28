"""Synchronous client of torque streams, for controllers on the same host or network."""

from __future__ import annotations

import socket
from contextlib import ExitStack
from pathlib import Path
from time import monotonic
from typing import Any, Self, cast
from warnings import warn

from numpy.typing import ArrayLike
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from lipserve.answers import (
    StreamAnswer,
    StreamError,
    StreamExternal,
    StreamHello,
    StreamLearnt,
    StreamPart,
    StreamRefusal,
    StreamReply,
)
from lipserve.exchange import closed, unanswered, unsettled
from lipserve.frames import ASK_CORIOLIS, ASK_GRAVITY, ASK_MASS_MATRIX, ASK_STD
from lipserve.stream_side import ASK_WARNING, StreamSide

__all__ = [
    "StreamAnswer",
    "StreamClient",
    "StreamError",
    "StreamExternal",
    "StreamHello",
    "StreamLearnt",
    "StreamPart",
    "StreamRefusal",
]


class StreamClient(StreamSide):
    """Synchronous torque stream. Use it as a context manager, or close it. Do not share it between threads.

    Args:
        model: Name of the model.
        url: As in `Client`.
        unix: Path of the service's Unix-domain socket, instead of host and port.
        version: Version number. Default: the serving version, also if it changes.
        timeout: Max time to wait for an answer without a deadline, s.
        stream_id: Name of the robot or recording, to let the model learn from sent torques. Default: do not learn.
        first_sequence: Sequence of the first frame. To send torques again after a lost connection, start with the
            first sequence above that of `learnt`.
        alias: Alias of the version, instead of its number; followed if it moves.
        key: As in `Client`.
        scale: Request the factor on the half width of intervals with every answer.
        payload: Request the estimated payload with every answer.
        rich: Answer from all centres of a correction (`rigid-body+local`), which takes longer.
        without_gravity: Return torques minus gravity, with the standard deviation of the difference, for robots that
            add gravity.

    Raises:
        StreamError: The service cannot be reached or refuses the stream.

    Example:
        >>> with StreamClient("panda-sim") as stream:
        ...     answer = stream.predict([0.0] * 7, [0.0] * 7, [0.0] * 7)
        >>> answer.tau.shape
        (7,)
    """

    def _begin(self) -> None:
        self._connect()
        self._receive(self._patience)

    def _connect(self) -> None:
        self._stack = ExitStack()
        address, host, port = self._destination
        with self._opening():
            made = _connect(host, port, self._unix, self._patience)
            self._socket = self._stack.enter_context(connect(address, sock=made, **self._options))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._stack.close()

    def predict(
        self,
        q: ArrayLike,
        dq: ArrayLike,
        ddq: ArrayLike,
        std: bool = True,
        deadline: float = 0.0,
        tau: ArrayLike | None = None,
        external: bool = False,
        learn: bool = True,
    ) -> StreamAnswer:
        """Predict the torque at one motion.

        If the deadline passes, the call returns the last answer that came in time, marked as `late` and with its own
        sequence. The next call drops the answer that arrives too late.

        Args:
            q: (n,) positions, rad (prismatic: m).
            dq: (n,) velocities, rad/s.
            ddq: (n,) accelerations, rad/s².
            std: Request the standard deviation.
            deadline: Max time for this call, s; 0: wait for `timeout`.
            tau: (n,) torque measured at this motion, N·m. The model learns from it after the answer, if the client
                has a stream_id and learn is True.
            external: Request the external torque, i.e. the part of tau that the model does not explain.
            learn: Whether the model may learn from tau.

        Returns:
            The answer.

        Raises:
            ValueError: The arguments have wrong shapes or do not fit together.
            StreamError: The service rejects the motion (the stream stays open), is not reachable, or does not answer
                in time (code `timeout`) and no earlier answer came in time.
        """
        end = self._until(deadline)
        sequence = self.send(q, dq, ddq, std, deadline, tau, external, learn)
        return cast("StreamAnswer", self._wait(0, sequence, deadline, end))

    def gravity(self, q: ArrayLike, std: bool = True, deadline: float = 0.0) -> StreamPart:
        """Return the torque that holds the arm against gravity, g(q), with the payload of the stream.

        If the deadline passes, the call returns the last gravity that came in time, as `predict` does.

        Args:
            q: (n,) positions, rad (prismatic: m).
            std: Request the standard deviation.
            deadline: Max time for this call, s; 0: wait for `timeout`.

        Returns:
            Mean (n,), N·m (prismatic: N), and standard deviation.

        Raises:
            ValueError: q has a wrong shape.
            StreamError: As in `predict`; also if the model has no gravity, mass matrix or Coriolis torque.

        Example: computed torque, without friction.
            >>> matrix, bias = stream.mass_matrix(q).mean, stream.coriolis(q, dq).mean + stream.gravity(q).mean
            >>> tau = matrix @ ddq + bias
        """
        return self._part(ASK_GRAVITY, deadline, ASK_STD if std else 0, q)

    def mass_matrix(self, q: ArrayLike, deadline: float = 0.0) -> StreamPart:
        """Return the mass matrix M(q), (n, n), with the inertia of the rotors; see `gravity`."""
        return self._part(ASK_MASS_MATRIX, deadline, 0, q)

    def coriolis(self, q: ArrayLike, dq: ArrayLike, deadline: float = 0.0) -> StreamPart:
        """Return the Coriolis and centrifugal torque c(q, dq), (n,) N·m; see `gravity`. dq: (n,) velocities, rad/s."""
        return self._part(ASK_CORIOLIS, deadline, 0, q, dq)

    def ask(self, *args: Any, **options: Any) -> StreamAnswer:
        """Deprecated name of `predict`."""
        warn(ASK_WARNING.format("StreamClient"), DeprecationWarning, stacklevel=2)
        return self.predict(*args, **options)

    def send(
        self,
        q: ArrayLike,
        dq: ArrayLike,
        ddq: ArrayLike,
        std: bool = True,
        deadline: float = 0.0,
        tau: ArrayLike | None = None,
        external: bool = False,
        learn: bool = True,
    ) -> int:
        """Send a query and return its sequence. Arguments: see `predict`; `receive` returns the answer."""
        return self._send(*self._exchange.frame(q, dq, ddq, std, deadline, tau, external, learn))

    def receive(self) -> StreamAnswer:
        """Return the answer to the oldest open query; raise StreamError if the query was rejected."""
        while (answer := self._exchange.answer()) is None:
            self._receive(self.timeout)
        return answer

    def flush(self, timeout: float | None = None) -> StreamLearnt:
        """Wait until all sent torques are acknowledged or refused, and return the totals.

        Answers that arrive meanwhile are kept for `receive`.

        Args:
            timeout: Max time to wait, s. Default: 10 s, or the client's timeout if that is longer.

        Raises:
            StreamError: It takes longer, or the service is not reachable.
        """
        timeout = self._patience if timeout is None else timeout
        end = monotonic() + timeout
        while self._exchange.unsettled:
            try:
                self._receive(max(end - monotonic(), 0.0))
            except StreamError as error:
                if error.code != "timeout":
                    raise
                raise unsettled(len(self._exchange.unsettled), timeout) from error
        return self._exchange.learnt

    def _part(self, kind: int, deadline: float, more: int, *vectors: ArrayLike) -> StreamPart:
        end = self._until(deadline)
        sequence = self._send(*self._exchange.part_frame(kind | more, deadline, *vectors))
        return cast("StreamPart", self._wait(kind, sequence, deadline, end))

    def _send(self, sequence: int, frame: bytes) -> int:
        try:
            self._socket.send(frame)
        except ConnectionClosed as error:
            raise closed(error) from error
        return sequence

    def _wait(self, kind: int, sequence: int, deadline: float, end: float) -> StreamReply:
        """Return the answer to a query, or the last one of its kind. kind: 0 for torque, else a flag."""
        while (reply := self._answer_to(sequence)) is None:
            try:
                self._receive(max(0.0, end - monotonic()))
            except StreamError as error:
                return self._late(kind, sequence, deadline, error)
        return self._in_time(kind, reply)

    def _receive(self, timeout: float) -> None:
        """Receive and process one message."""
        try:
            message = self._socket.recv(timeout)
        except TimeoutError as error:
            raise unanswered(timeout) from error
        except ConnectionClosed as error:
            raise closed(error) from error
        try:
            self._exchange.receive(message)
        except StreamError:  # unsupported frame layout
            self.close()
            raise


def _connect(host: str, port: int, unix: Path | None, timeout: float) -> socket.socket:
    """Open a connection without Nagle's delay; ignore proxy settings of the environment."""
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

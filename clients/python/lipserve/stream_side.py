"""What both clients of torque streams share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from time import monotonic
from typing import Any

from websockets.exceptions import InvalidHandshake, InvalidStatus

from lipserve.address import Address, headers_of, url_of
from lipserve.answers import StreamError, StreamHello, StreamLearnt, StreamRefusal, StreamReply
from lipserve.call import split_name
from lipserve.exchange import Exchange, destination, refused, unanswered

PATIENCE_S = 10.0
"""Min timeout for opening and flushing a stream, s; a control loop's `timeout` may be shorter."""
ASK_WARNING = "{0}.ask is deprecated since 0.3 and will be removed in 0.4. Use {0}.predict."


class StreamSide:
    """Common part of both stream clients. Arguments: see `StreamClient`."""

    def __init__(
        self,
        model: str,
        url: str | None = None,
        unix: Path | str | None = None,
        version: int | None = None,
        timeout: float = 1.0,
        stream_id: str | None = None,
        first_sequence: int = 1,
        alias: str | None = None,
        key: str | None = None,
        scale: bool = False,
        payload: bool = False,
        rich: bool = False,
        without_gravity: bool = False,
    ) -> None:
        headers = headers_of(key)
        address = Address.of(url_of(url))
        self.timeout, self._url = timeout, address.base
        self._unix = address.unix if unix is None else Path(unix)
        self._exchange = Exchange(stream_id, first_sequence)
        self._last: dict[int, StreamReply] = {}  # last answers in time, by kind
        model, which = split_name(model, version, alias)
        query = {**which, "stream_id": stream_id}
        flags = {"scale": scale, "payload": payload, "rich": rich, "without_gravity": without_gravity}
        query |= {name: 1 if wanted else None for name, wanted in flags.items()}
        self._destination = destination(address.base, model, **query)
        self._options: dict[str, Any] = {
            "compression": None,
            "open_timeout": self._patience,
            "close_timeout": 1.0,
            "additional_headers": headers,
        }
        self._begin()

    @property
    def _patience(self) -> float:
        """Max time to wait for a connection and for acknowledgements, s."""
        return max(PATIENCE_S, self.timeout)

    def _begin(self) -> None:
        """Open the stream, if the constructor of the client does so."""

    @contextmanager
    def _opening(self) -> Iterator[None]:
        """Convert connection errors in the block to StreamError."""
        try:
            yield
        except InvalidStatus as error:
            raise refused(error.response.status_code, error.response.body) from error
        except (OSError, InvalidHandshake) as error:
            raise StreamError(f"no service answers at {self._unix or self._url}: {error}", "unreachable") from error

    def _until(self, deadline: float) -> float:
        """Return when to stop waiting for an answer, by `monotonic`."""
        return monotonic() + (deadline or self.timeout)

    def _in_time(self, kind: int, reply: StreamReply) -> StreamReply:
        """Return the answer, or the last one of its kind in time if it is late. kind: 0 for torque, else a flag."""
        if not reply.late:
            self._last[kind] = reply
        return self._last_marked_late(kind) if reply.late and kind in self._last else reply

    def _late(self, kind: int, sequence: int, deadline: float, error: StreamError) -> StreamReply:
        """Return the last answer in time, instead of one that missed its deadline; raise StreamError without one."""
        if error.code != "timeout":
            raise error
        self._exchange.given_up(sequence)
        if not deadline or kind not in self._last:
            raise unanswered(deadline or self.timeout) from error
        return self._last_marked_late(kind)

    def _last_marked_late(self, kind: int) -> StreamReply:
        return replace(self._last[kind], late=True, late_answers=self._exchange.late_answers)

    def _answer_to(self, sequence: int) -> StreamReply | None:
        """Return the answer to a query if it has arrived, dropping earlier ones; raise StreamError if rejected."""
        while self._exchange.answers:
            try:
                reply = self._exchange.reply()
            except StreamError as error:
                if error.sequence is None or error.sequence == sequence:
                    raise
                continue
            if reply.sequence == sequence:
                return reply
        return None

    @property
    def hello(self) -> StreamHello:
        """Description of the version that answers, as last received."""
        assert self._exchange.hello is not None, "the stream is not open: use `async with`"
        return self._exchange.hello

    @property
    def learnt(self) -> StreamLearnt:
        """Acknowledged torques of this connection, as last received."""
        return self._exchange.learnt

    @property
    def refusals(self) -> tuple[StreamRefusal, ...]:
        """Last 1000 refusals to log torques, as received so far."""
        return tuple(self._exchange.refusals)

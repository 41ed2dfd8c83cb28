"""Connections of both planes are counted together, by the data plane, which admits them.

The control plane reports how many connections it answers. Between two reports the data plane adds what it has passed
on since.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from service.api.server.connection_limit import ConnectionLimit

REPORT_S = 0.1
"""Seconds between two reports, if the number of connections has changed."""
MAX_SHED_S = 0.2
"""Max wait for the control plane to close a connection, s."""


@dataclass(frozen=True)
class ConnectionReport:
    """The connections that the control plane answers."""

    through: int = 0
    """Number of the newest connection that it has adopted, see `Handed`."""
    counts: Mapping[str | None, int] = field(default_factory=dict)
    """Number of connections by client; None: of those that do not identify their client."""


@dataclass(frozen=True)
class ShedConnection:
    """Asks the control plane to close an idle connection, of one client if given."""

    number: int
    peer: str | None


@dataclass(frozen=True)
class ConnectionShed:
    """The answer to `ShedConnection`: whether there was an idle connection."""

    number: int
    done: bool


class PassedConnections:
    """The connections that the control plane answers, as the data plane counts them. Use it in the event loop.

    send: sends a message to the control plane; it returns whether it was sent.
    """

    def __init__(self, send: Callable[[Any], bool]) -> None:
        self._send = send
        self._passed, self._newest = deque[tuple[int, str | None]](), 0
        self._report, self._total = ConnectionReport(), 0
        self._shedding: dict[int, asyncio.Future[bool]] = {}

    def number(self, peer: str | None) -> int:
        """Count a connection that is passed on; return its number."""
        self._newest += 1
        self._passed.append((self._newest, peer))
        return self._newest

    def forget(self, number: int) -> None:
        """Uncount a connection that could not be passed on."""
        self._passed = deque(each for each in self._passed if each[0] != number)

    def update(self, report: ConnectionReport) -> None:
        """Replace the last report."""
        self._report, self._total = report, sum(report.counts.values())
        while self._passed and self._passed[0][0] <= report.through:
            self._passed.popleft()

    def clear(self) -> None:
        """Forget all: the control plane has ended, and its connections with it."""
        self._passed.clear()
        self.update(ConnectionReport())
        for number in self._shedding:
            self.receive(ConnectionShed(number, done=True))

    def count(self, peer: str | None) -> int:
        """Return the number of connections of a client; None: of all."""
        if peer is None:
            return self._total + len(self._passed)
        return self._report.counts.get(peer, 0) + sum(each == peer for _, each in self._passed)

    async def shed(self, peer: str | None) -> bool:
        """Let the control plane close an idle connection, of one client if given; return whether it has."""
        if not self.count(peer):
            return False
        self._newest = number = self._newest + 1
        self._shedding[number] = done = asyncio.get_running_loop().create_future()
        try:
            if not self._send(ShedConnection(number, peer)):
                return False
            return await asyncio.wait_for(done, MAX_SHED_S)
        except TimeoutError:
            return False
        finally:
            del self._shedding[number]

    def receive(self, answer: ConnectionShed) -> None:
        """Pass the answer of the control plane to the connection that waits for it."""
        if (done := self._shedding.get(answer.number)) is not None and not done.done():
            done.set_result(answer.done)


class AdoptedConnections:
    """The connections of the control plane, which it reports to the data planes. Use it in the event loop.

    present: all connections; send: sends a message to the data planes. through, sent: number of the newest connection
    that was adopted, and the last report.
    """

    def __init__(self, limit: ConnectionLimit, present: Collection[Any], send: Callable[[Any], None]) -> None:
        self._limit, self._present, self._send = limit, present, send
        self.through, self.sent = 0, ConnectionReport()

    async def report(self) -> None:
        """Report changes until cancelled."""
        while True:
            await asyncio.sleep(REPORT_S)
            self.report_now()

    def report_now(self) -> None:
        """Report what has changed since the last report."""
        made = ConnectionReport(self.through, dict(self._limit.count_by_peer(self._present)))
        if made != self.sent:
            self.sent = made
            self._send(made)

    def shed(self, asked: ShedConnection) -> ConnectionShed:
        """Close an idle connection if there is one."""
        return ConnectionShed(asked.number, self._limit.shed(asked.peer))

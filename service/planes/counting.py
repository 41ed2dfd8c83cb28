"""Connections of both planes are counted together, by the data plane, which admits them.

The control plane reports how many connections it answers. Between two reports the data plane adds what it has passed
on since.
"""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from time import monotonic
from typing import Any

from service.api.server.connection_limit import ConnectionLimit

REPORT_S = 0.1
"""Seconds between two reports, if the number of connections has changed."""
BUSY_S = 1.0
"""Seconds for which no connection is shed after the control plane had no idle one."""


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

    peer: str | None


@dataclass(frozen=True)
class NoneIdle:
    """The answer of the control plane if it has no idle connection to close."""


class PassedConnections:
    """The connections that the control plane answers, as the data plane counts them. Use it in the event loop.

    send: sends a message to the control plane; it returns whether it was sent.
    """

    def __init__(self, send: Callable[[Any], bool]) -> None:
        self._send = send
        self._passed, self._newest = deque[tuple[int, str | None]](), 0
        self._report, self._total, self._busy_until = ConnectionReport(), 0, 0.0

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

    def count(self, peer: str | None) -> int:
        """Return the number of connections of a client; None: of all."""
        if peer is None:
            return self._total + len(self._passed)
        return self._report.counts.get(peer, 0) + sum(each == peer for _, each in self._passed)

    def shed(self, peer: str | None) -> bool:
        """Let the control plane close an idle connection; return False if it lately had none."""
        if not self.count(peer) or monotonic() < self._busy_until:
            return False
        return self._send(ShedConnection(peer))

    def note_busy(self) -> None:
        """Note that the control plane has no idle connection."""
        self._busy_until = monotonic() + BUSY_S


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
        made = ConnectionReport(self.through, dict(Counter(self._limit.count_by_peer(self._present))))
        if made != self.sent:
            self.sent = made
            self._send(made)

    def shed(self, asked: ShedConnection) -> None:
        """Close an idle connection, or reply that there is none."""
        if self._limit.shed(asked.peer):
            self.report_now()
        else:
            self._send(NoneIdle())

"""The limit on open connections: a new connection replaces the one that has been idle longest.

A client can open idle connections without an API key, so they must not block new ones. A client at its own limit
replaces its own connections.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from typing import Any, NamedTuple, Protocol

from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from service.api.limits.requests import network_of
from service.foundation.settings import Settings


class LimitedConnection(Protocol):
    """A connection that can be closed to make room."""

    peer: str | None
    """The client's address or network; None if it does not identify the client, as behind a proxy."""

    def drop(self) -> None:
        """Close at once, without finishing an answer."""
        ...


class OtherConnections(Protocol):
    """The connections of the same server that another process answers. `peer` None: of all clients."""

    def count(self, peer: str | None) -> int:
        """Return the number of connections of a client."""
        ...


class Excess(NamedTuple):
    """How many connections there are above a limit, and which limit that is."""

    number: int
    why: str = ""
    peer: str | None = None
    """The client whose own limit it is; None: the limit of all."""


class ConnectionLimit:
    """The connections of one server, in the order in which they are closed. Use it in the event loop.

    First come connections without any request, then idle ones after an answer, then those of clients that do not read
    their answer; the oldest of each kind first. A connection that is being answered is never closed.
    `others` are counted too, but not closed.
    """

    def __init__(self, settings: Settings, others: OtherConnections | None = None) -> None:
        self.most, self.most_of_one = settings.max_connections, settings.max_connections_per_client
        self.others = others
        self._trusted: Any = ProxyHeadersMiddleware(_nothing, settings.trusted_proxies).trusted_hosts
        self._fresh: dict[LimitedConnection, None] = {}
        self._rested: dict[LimitedConnection, None] = {}
        self._unread: dict[LimitedConnection, None] = {}
        self._leaving: set[LimitedConnection] = set()

    def find_peer(self, client: tuple[str, int] | None) -> str | None:
        """Return the address or network of a client; None for a local socket or a trusted proxy."""
        if client is None or client[0] in self._trusted:
            return None
        return network_of(client[0])

    def admit(self, connection: LimitedConnection, present: Collection[Any]) -> Excess:
        """Make room for a new connection; `present` are all connections, including this one.

        Return the connections above a limit, 0 if there is room now.
        """
        self.adopt(connection)
        own = self._beyond_own(connection, present)
        if own.number > 0 and not self.shed(connection.peer, connection):
            return own
        beyond = len(present) + self._count_others(None) - len(self._leaving) - self.most
        if beyond > 0 and not self.shed(None, connection):
            return Excess(beyond, f"Too many connections: at most {self.most} (LIPSERVE_MAX_CONNECTIONS).")
        return Excess(0)

    def adopt(self, connection: LimitedConnection) -> None:
        """Add a connection that another process has admitted."""
        self._fresh[connection] = None

    def mark_busy(self, connection: LimitedConnection) -> None:
        """Mark a connection that has a request or is no longer an HTTP connection."""
        if connection in self._fresh:
            del self._fresh[connection]
        elif connection in self._rested:
            del self._rested[connection]
        else:
            self._unread.pop(connection, None)

    def mark_idle(self, connection: LimitedConnection, unread: bool) -> None:
        """Mark a connection that has been answered; `unread`: the client has not read the whole answer yet."""
        if connection not in self._leaving:
            (self._unread if unread else self._rested)[connection] = None

    def remove(self, connection: LimitedConnection) -> None:
        """Remove a closed connection."""
        self.mark_busy(connection)
        self._leaving.discard(connection)

    def _beyond_own(self, connection: LimitedConnection, present: Collection[Any]) -> Excess:
        if connection.peer is None or len(present) + self._count_others(None) <= self.most_of_one:
            return Excess(0)
        own = sum(self._peer_of(each) == connection.peer for each in present if each not in self._leaving)
        own += self._count_others(connection.peer)
        limit = f"at most {self.most_of_one} (LIPSERVE_MAX_CONNECTIONS_PER_CLIENT)"
        why = f"Too many connections from {connection.peer}: {limit}."
        return Excess(own - self.most_of_one, why, connection.peer)

    def _peer_of(self, connection: Any) -> str | None:
        if hasattr(connection, "peer"):
            peer: str | None = connection.peer
            return peer
        return self.find_peer(connection.client)  # a stream

    def count_by_peer(self, present: Collection[Any]) -> Counter[str | None]:
        """Return the number of connections of each client; None: of those that do not identify their client."""
        return Counter(self._peer_of(each) for each in present if each not in self._leaving)

    def _count_others(self, peer: str | None) -> int:
        return 0 if self.others is None else self.others.count(peer)

    def shed(self, peer: str | None, coming: LimitedConnection | None = None) -> bool:
        """Close the first idle connection except the new one, of one client if given; return whether there was one."""
        for connection in self._idle():
            if connection is not coming and peer in (None, connection.peer):
                self.mark_busy(connection)
                self._leaving.add(connection)
                connection.drop()
                return True
        return False

    def _idle(self) -> Iterator[LimitedConnection]:
        yield from self._fresh
        yield from self._rested
        yield from self._unread


async def _nothing(*_: Any) -> None:
    """Stand in for an application: only the middleware's list of trusted hosts is used."""

"""Who gives way when there are more connections than there may be: those that ask nothing.

To open a connection and keep it takes nothing, no key either. So a new one, which may be about to ask, takes the place
of one that has not asked for longest; an address that holds many takes its own.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any, Protocol

from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from service.api.limits.requests import network_of
from service.foundation.settings import Settings


class Guest(Protocol):
    """A connection that may be asked to leave."""

    peer: str | None
    """Its client's address or network; None where that says nothing of who it is, as behind a proxy."""

    def leave(self) -> None:
        """Close, without an answer that is under way."""
        ...


class Room:
    """The connections of one server, in the order in which they give way: those that have never asked, then those that
    have been answered, then those whose clients do not read the answer; each kind from the oldest on. One that is being
    answered never does. For the event loop."""

    def __init__(self, settings: Settings) -> None:
        self.most, self.most_of_one = settings.max_connections, settings.max_connections_per_client
        self._trusted: Any = ProxyHeadersMiddleware(_nothing, settings.trusted_proxies).trusted_hosts
        self._fresh: dict[Guest, None] = {}
        self._rested: dict[Guest, None] = {}
        self._unread: dict[Guest, None] = {}
        self._leaving: set[Guest] = set()

    def peer(self, client: tuple[str, int] | None) -> str | None:
        """Whose a connection is; None for a local socket, and for a proxy, behind which are many."""
        if client is None or client[0] in self._trusted:
            return None
        return network_of(client[0])

    def admit(self, guest: Guest, present: Collection[Any]) -> tuple[int, str]:
        """Make room for a connection that has just come. present: all that there are, this one too.

        Return how many there are too many of, 0 where there is room now, and why.
        """
        self._fresh[guest] = None
        beyond, why = self._beyond_own(guest, present)
        if beyond <= 0 or self._shed(guest, guest.peer):
            beyond = len(present) - len(self._leaving) - self.most
            why = f"{self.most} connections are open, the most there may be (LIPSERVE_MAX_CONNECTIONS)"
            if beyond <= 0 or self._shed(guest, None):
                return 0, ""
        return beyond, why

    def busy(self, guest: Guest) -> None:
        """Take note that a connection asks something, or is an HTTP connection no longer."""
        if guest in self._fresh:
            del self._fresh[guest]
        elif guest in self._rested:
            del self._rested[guest]
        else:
            self._unread.pop(guest, None)

    def rest(self, guest: Guest, unread: bool) -> None:
        """Take note that a connection has been answered. unread: the client has not taken all of it yet."""
        if guest not in self._leaving:
            (self._unread if unread else self._rested)[guest] = None

    def gone(self, guest: Guest) -> None:
        """Take note of the end of a connection."""
        self.busy(guest)
        self._leaving.discard(guest)

    def _beyond_own(self, guest: Guest, present: Collection[Any]) -> tuple[int, str]:
        if guest.peer is None or len(present) <= self.most_of_one:
            return 0, ""
        own = sum(self._peer_of(each) == guest.peer for each in present if each not in self._leaving)
        why = f"{guest.peer} has {self.most_of_one} connections, the most of one (LIPSERVE_MAX_CONNECTIONS_PER_CLIENT)"
        return own - self.most_of_one, why

    def _peer_of(self, connection: Any) -> str | None:
        if hasattr(connection, "peer"):
            peer: str | None = connection.peer
            return peer
        return self.peer(connection.client)  # a stream

    def _shed(self, coming: Guest, peer: str | None) -> bool:
        """Let the first one go that may, but not the one that comes; of a client only, where given."""
        for guest in self._idle():
            if guest is not coming and peer in (None, guest.peer):
                self.busy(guest)
                self._leaving.add(guest)
                guest.leave()
                return True
        return False

    def _idle(self) -> Iterator[Guest]:
        yield from self._fresh
        yield from self._rested
        yield from self._unread


async def _nothing(*_: Any) -> None:
    """No application: of the middleware only the list of those who are trusted is used."""

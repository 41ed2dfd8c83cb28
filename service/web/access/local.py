"""A service without keys: this machine only, so what is left to fear are web pages that its browsers show."""

from __future__ import annotations

import re

from starlette.types import ASGIApp, Receive, Scope, Send

from service.foundation.errors import ForbiddenError, ServiceError, problem, readable, refuse
from service.foundation.settings import is_loopback

SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
"""Methods that change nothing, and whose answers browsers keep from pages of other sites."""
MOST_KNOWN = 100
_HOST = re.compile(r"(?:\[([^\[\]]*)\]|([^:\[\]]*))(?::[0-9]*)?")
"""An address of IPv6 in brackets, or another name, and a port or none."""


class LocalAccess:
    """Middleware that refuses requests of other sites' web pages.

    Host: a site can let its own name lead to 127.0.0.1 (DNS rebinding), and its pages then pass for this service's own;
    but the name stays theirs. Origin: a page may send to any address, but has to say from where. Neither header can be
    changed by a page; a program that asks does without Origin.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app
        self._known: set[bytes] = set()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer it with 403."""
        if scope["type"] != "lifespan":
            host = origin = None
            for name, value in scope["headers"]:
                if name == b"host":
                    host = value
                elif name == b"origin":
                    origin = value
            if host is not None and host not in self._known and not self._is_local(host):
                await refuse(_wrong_host(host), scope, receive, send)
                return
            changes = scope["type"] == "websocket" or scope["method"] not in SAFE
            if origin is not None and changes and origin.partition(b"://")[2] != host:
                await refuse(_wrong_origin(origin), scope, receive, send)
                return
        await self.app(scope, receive, send)

    def _is_local(self, host: bytes) -> bool:
        name = host.decode("latin-1")
        found = _HOST.fullmatch(name)
        if found is None or not is_loopback((found[1] or found[2]).lower().removesuffix(".")):
            return False
        if len(self._known) < MOST_KNOWN:
            self._known.add(host)
        return True


def _wrong_host(host: bytes) -> ServiceError:
    name = readable(host.decode("latin-1")[:200])
    said = (
        f"the host is {name!r}: a service without keys answers to localhost and addresses of loopback only. "
        "Behind a proxy or a forwarded port let it ask for keys: LIPSERVE_KEYS=on"
    )
    return ForbiddenError(said, [problem("host", name, "localhost or an address of loopback")])


def _wrong_origin(origin: bytes) -> ServiceError:
    name = readable(origin.decode("latin-1")[:200])
    said = f"the origin {name!r} is not this service: web pages of other sites may not ask"
    return ForbiddenError(said, [problem("origin", name, "this service, or none")])

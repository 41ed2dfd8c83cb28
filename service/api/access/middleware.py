"""Who is let through: who has a key for what is asked; without keys, all but the web pages of other sites.

A key is in the header `Authorization`, from browsers in a WebSocket's subprotocol.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import partial

from anyio import CancelScope
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.access.keys import CHALLENGE, Key, Keyring, refusal
from service.api.access.scopes import ADMIN, WEBSOCKET, Rules, scopes_of_stream
from service.api.errors import refuse
from service.api.limits.requests import COUNTED
from service.api.server.connections import CONNECTION, StreamProtocol
from service.foundation.errors import ForbiddenError, NotFoundError, ServiceError, problem, readable
from service.foundation.settings import is_loopback
from service.telemetry.logs import KEY_ID

SUBPROTOCOL = "lipserve"
KEY_SUBPROTOCOL = "lipserve.key."
"""Browsers can give a WebSocket no header: `new WebSocket(url, ["lipserve", "lipserve.key." + key])`."""


def secret_of(scope: Scope) -> bytes | None:
    """Return the key that a request carries, None where it carries none."""
    for name, value in scope["headers"]:
        if name == b"authorization":
            given: bytes = value
            if given[:7] == b"Bearer " or given[:7].lower() == b"bearer ":
                return given[7:].strip()
            return None
    for offered in scope.get("subprotocols", ()):
        if offered.startswith(KEY_SUBPROTOCOL):
            return str(offered).removeprefix(KEY_SUBPROTOCOL).encode("latin-1", "replace")
    return None


def subprotocol_of(offered: Iterable[str]) -> str | None:
    """Return the subprotocol to agree on, None where only the key is offered: answers repeat no keys."""
    return SUBPROTOCOL if SUBPROTOCOL in offered else None


FOREIGN = frozenset({b"cross-site", b"same-site"})
"""What a browser says of a request that a page of another origin makes: another port is one, of the same site."""
MOST_KNOWN = 100
_HOST = re.compile(r"(?:\[([^\[\]]*)\]|([^:\[\]]*))(?::[0-9]*)?")
"""An address of IPv6 in brackets, or another name, and a port or none."""


class LocalAccess:
    """Middleware that refuses requests of other sites' web pages.

    Host: a site can let its own name lead to 127.0.0.1 (DNS rebinding), and its pages then pass for this service's own;
    but the name stays theirs. Origin, and Sec-Fetch-Site where a browser leaves that out: a page may ask any address,
    but has to say from where. It could not read the answer, but hold streams of events open, or have archives made. A
    link that somebody follows is no such request. None of these headers can be changed by a page; a program that asks
    does without.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app
        self._known: set[bytes] = set()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer it with 403."""
        if scope["type"] != "lifespan":
            host = origin = site = mode = target = None
            for name, value in scope["headers"]:
                if name == b"host":
                    host = value
                elif name == b"origin":
                    origin = value
                elif name == b"sec-fetch-site":
                    site = value
                elif name == b"sec-fetch-mode":
                    mode = value
                elif name == b"sec-fetch-dest":
                    target = value
            if host is not None and host not in self._known and not self._is_local(host):
                await refuse(_wrong_host(host), scope, receive, send)
                return
            if origin is not None and origin.partition(b"://")[2] != host:
                await refuse(_wrong_origin(origin), scope, receive, send)
                return
            if site in FOREIGN and not self._is_link(scope, mode, target):
                await refuse(_wrong_origin(b"of a page that is " + (site or b"")), scope, receive, send)
                return
        await self.app(scope, receive, send)

    @staticmethod
    def _is_link(scope: Scope, mode: bytes | None, target: bytes | None) -> bool:
        """Whether a browser asks for a page to be shown by itself, not within one of another site."""
        safe = scope["type"] == "http" and scope["method"] in ("GET", "HEAD", "OPTIONS")  # these change nothing
        return safe and mode == b"navigate" and target == b"document"

    def _is_local(self, host: bytes) -> bool:
        name = host.decode("latin-1")
        match = _HOST.fullmatch(name)
        if match is None or not is_loopback((match[1] or match[2]).lower().removesuffix(".")):
            return False
        if len(self._known) < MOST_KNOWN:
            self._known.add(host)
        return True


def _wrong_host(host: bytes) -> ServiceError:
    name = readable(host.decode("latin-1")[:200])
    message = (
        f"the host is {name!r}: a service without keys answers to localhost and addresses of loopback only. "
        "Behind a proxy or a forwarded port let it ask for keys: LIPSERVE_KEYS=on"
    )
    return ForbiddenError(message, [problem("host", name, "localhost or an address of loopback")])


def _wrong_origin(origin: bytes) -> ServiceError:
    name = readable(origin.decode("latin-1")[:200])
    message = f"the origin {name!r} is not this service: web pages of other sites may not ask"
    return ForbiddenError(message, [problem("origin", name, "this service, or none")])


class KeyAccess:
    """Middleware that asks for a key, and for the scope that the route needs; streams end with their key."""

    def __init__(self, app: ASGIApp, keyring: Keyring) -> None:
        self.app, self.keyring = app, keyring

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer it with 401, 403, 429, or 404 where there is no such route."""
        kind = scope["type"]
        if kind == "lifespan":
            await self.app(scope, receive, send)
            return
        rules: Rules = scope["app"].state.rules
        rule = rules.of(scope["method"] if kind == "http" else WEBSOCKET, scope["path"])
        if rule is not None and rule.scope is None:
            await self.app(scope, receive, send)
            return
        try:
            key = self.keyring.find(secret_of(scope))
            scope[KEY_ID] = key.id  # also of what is refused: the log is to say whose it was
            self.keyring.use(key)
            if key.rate is not None:
                key.rate.count(key.id)
                scope[COUNTED] = True
            if rule is None:
                _check_unknown(key, scope)
            else:
                assert rule.scope is not None
                _check(key, (rule.scope,) if kind == "http" else scopes_of_stream(scope["query_string"]))
        except ServiceError as error:
            await refuse(error, scope, receive, send)
            return
        if rule is None or not rule.lasting:
            await self.app(scope, receive, send)
        elif kind == "websocket":
            await self._stream(key, scope, receive, send)
        else:
            await self._events(key, scope, receive, send)

    async def _stream(self, key: Key, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a WebSocket talk until its key ends."""
        connection = scope.get("state", {}).get(CONNECTION)
        if not isinstance(connection, StreamProtocol):  # the route says that it cannot talk
            await self.app(scope, receive, send)
            return
        end = partial(connection.end, 1008, f"the API key {key.id} is no longer valid")  # policy violation
        with self.keyring.lasting(key, end):
            await self.app(scope, receive, send)

    async def _events(self, key: Key, scope: Scope, receive: Receive, send: Send) -> None:
        """Let events be sent until their key ends."""
        started = False

        async def watched(message: Message) -> None:
            nonlocal started
            started = True
            await send(message)

        with CancelScope() as until, self.keyring.lasting(key, until.cancel):
            await self.app(scope, receive, watched)
            return
        if started:
            await send({"type": "http.response.body", "body": b"", "more_body": False})
        else:
            await refuse(refusal(f"the API key {key.id} is no longer valid"), scope, receive, send)


def _check(key: Key, scopes: tuple[str, ...]) -> None:
    """Raise ForbiddenError where the key lacks one of the scopes."""
    for scope in scopes:
        if not key.allows(scope):
            may = ", ".join(sorted(key.scopes))
            message = f"the API key {key.id} has the scopes {may}: this needs {scope}"
            challenge = f'{CHALLENGE}, error="insufficient_scope", scope="{scope}"'
            raise ForbiddenError(message, headers={"WWW-Authenticate": challenge})


def _check_unknown(key: Key, scope: Scope) -> None:
    """Raise NotFoundError for a route that is not in the table, unless the key may do everything."""
    if not key.allows(ADMIN):
        method = scope.get("method", WEBSOCKET)
        raise NotFoundError(f"no route {method} {readable(scope['path'][:200])}: /docs lists all")

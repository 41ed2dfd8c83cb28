"""Access middleware: checks API keys and scopes or, without keys, refuses web pages of other sites.

A key is sent in the header `Authorization`, or by browsers in a WebSocket's subprotocol.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import partial

from anyio import CancelScope
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.access.keys import CHALLENGE, Key, Keyring, invalid_key
from service.api.access.scopes import ADMIN, WEBSOCKET, Rules, scopes_of_stream
from service.api.errors import refuse
from service.api.limits.requests import COUNTED
from service.api.server.streams import CONNECTION, StreamProtocol
from service.foundation.errors import ForbiddenError, NotFoundError, ServiceError, problem, readable
from service.foundation.settings import is_loopback
from service.telemetry.logs import KEY_ID

SUBPROTOCOL = "lipserve"
KEY_SUBPROTOCOL = "lipserve.key."
"""Browsers cannot set headers of a WebSocket: `new WebSocket(url, ["lipserve", "lipserve.key." + key])`."""


def secret_of(scope: Scope) -> bytes | None:
    """Return the key of a request, None if it has none."""
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
    """Return the subprotocol to accept, None if only the key is offered: a key must not be sent back."""
    return SUBPROTOCOL if SUBPROTOCOL in offered else None


OTHER_SITES = frozenset({b"cross-site", b"same-site"})
"""Values of Sec-Fetch-Site for pages of other origins. Another port of the same host is `same-site`."""
MAX_KNOWN_HOSTS = 100
_HOST = re.compile(r"(?:\[([^\[\]]*)\]|([^:\[\]]*))(?::[0-9]*)?")
"""An IPv6 address in brackets or another name, with an optional port."""


class LocalAccess:
    """Middleware that refuses requests from web pages of other sites, for a service without keys.

    - Host must be a local name. With DNS rebinding, a site points its own name to 127.0.0.1, but Host keeps that name.
    - Origin must be this service, and so must Sec-Fetch-Site, as some requests have no Origin. A foreign page cannot
      read the answers, but it could keep event streams open or start exports. Links to this service are allowed.

    Pages cannot change these headers. Programs usually do not send Origin or Sec-Fetch-Site.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app
        self._known: set[bytes] = set()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on or answer 403."""
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
            if site in OTHER_SITES and not self._is_link(scope, mode, target):
                await refuse(_wrong_origin(site or b""), scope, receive, send)
                return
        await self.app(scope, receive, send)

    @staticmethod
    def _is_link(scope: Scope, mode: bytes | None, target: bytes | None) -> bool:
        """Return whether a browser follows a link, rather than embedding the page in one of another site."""
        safe = scope["type"] == "http" and scope["method"] in ("GET", "HEAD", "OPTIONS")  # these change nothing
        return safe and mode == b"navigate" and target == b"document"

    def _is_local(self, host: bytes) -> bool:
        name = host.decode("latin-1")
        match = _HOST.fullmatch(name)
        if match is None or not is_loopback((match[1] or match[2]).lower().removesuffix(".")):
            return False
        if len(self._known) < MAX_KNOWN_HOSTS:
            self._known.add(host)
        return True


def _wrong_host(host: bytes) -> ServiceError:
    name = readable(host.decode("latin-1")[:200])
    message = (
        f"Host {name!r} is not allowed: without API keys, the service only answers at localhost and loopback "
        "addresses. Behind a proxy or a forwarded port, require keys: LIPSERVE_KEYS=on"
    )
    return ForbiddenError(message, [problem("host", name, "localhost or a loopback address")])


def _wrong_origin(origin: bytes) -> ServiceError:
    name = readable(origin.decode("latin-1")[:200])
    message = f"Requests from web pages of other sites are not allowed (origin {name!r})."
    return ForbiddenError(message, [problem("origin", name, "this service or none")])


class KeyAccess:
    """Middleware that checks the API key and the scope that the route needs. Streams end with their key."""

    def __init__(self, app: ASGIApp, keyring: Keyring) -> None:
        self.app, self.keyring = app, keyring

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on or answer 401, 403, 429, or 404 for an unknown route."""
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
            scope[KEY_ID] = key.id  # before the checks: the log also names the key of a refused request
            self.keyring.use(key)
            if key.rate is not None and COUNTED not in scope:
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
        """Serve a WebSocket until its key becomes invalid."""
        connection = scope.get("state", {}).get(CONNECTION)
        if not isinstance(connection, StreamProtocol):  # the route answers with an error
            await self.app(scope, receive, send)
            return
        end = partial(connection.end, 1008, _invalid(key))  # policy violation
        with self.keyring.lasting(key, end):
            await self.app(scope, receive, send)

    async def _events(self, key: Key, scope: Scope, receive: Receive, send: Send) -> None:
        """Send events until their key becomes invalid."""
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
            await refuse(invalid_key(_invalid(key)), scope, receive, send)


def _invalid(key: Key) -> str:
    return f"API key {key.id} is no longer valid."


def _check(key: Key, scopes: tuple[str, ...]) -> None:
    """Raise ForbiddenError if the key lacks one of the scopes."""
    for scope in scopes:
        if not key.allows(scope):
            may = ", ".join(sorted(key.scopes))
            message = f"API key {key.id} lacks the scope {scope}. Its scopes: {may}."
            challenge = f'{CHALLENGE}, error="insufficient_scope", scope="{scope}"'
            raise ForbiddenError(message, headers={"WWW-Authenticate": challenge})


def _check_unknown(key: Key, scope: Scope) -> None:
    """Raise NotFoundError for an unknown route, unless the key has the scope `admin`."""
    if not key.allows(ADMIN):
        method = scope.get("method", WEBSOCKET)
        raise NotFoundError(f"There is no route {method} {readable(scope['path'][:200])}. /docs lists all routes.")

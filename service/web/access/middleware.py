"""Lets a request through whose key may do what it asks."""

from __future__ import annotations

from functools import partial

from anyio import CancelScope
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.foundation.errors import ForbiddenError, NotFoundError, ServiceError, readable, refuse
from service.web.access.credentials import secret_of
from service.web.access.keyring import CHALLENGE, Keyring, refusal
from service.web.access.keys import Key
from service.web.access.scopes import ADMIN, WEBSOCKET, rule_of, scopes_of_stream
from service.web.observability.context import KEY_ID
from service.web.server.stream_protocol import CONNECTION, StreamProtocol

__all__ = ["KEY_ID", "KeyAccess"]

POLICY_VIOLATION = 1008


class KeyAccess:
    """Middleware that asks for a key, and for the scope that the route needs; streams end with their key."""

    def __init__(self, app: ASGIApp, keyring: Keyring) -> None:
        self.app, self.keyring = app, keyring

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer it with 401, 403, or 404 where there is no such route."""
        kind = scope["type"]
        if kind == "lifespan":
            await self.app(scope, receive, send)
            return
        rule = rule_of(scope["method"] if kind == "http" else WEBSOCKET, scope["path"])
        if rule is not None and not rule.scopes:
            await self.app(scope, receive, send)
            return
        try:
            key = self.keyring.find(secret_of(scope))
            scope[KEY_ID] = key.id  # also of what is refused: the log is to say whose it was
            self.keyring.use(key)
            if rule is None:
                _check_unknown(key, scope)
            else:
                _check(key, rule.scopes if kind == "http" else scopes_of_stream(scope["query_string"]))
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
        end = partial(connection.end, POLICY_VIOLATION, f"the API key {key.id} is no longer valid")
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
            said = f"the API key {key.id} has the scopes {may}: this needs {scope}"
            challenge = f'{CHALLENGE}, error="insufficient_scope", scope="{scope}"'
            raise ForbiddenError(said, headers={"WWW-Authenticate": challenge})


def _check_unknown(key: Key, scope: Scope) -> None:
    """Raise NotFoundError for a route that is not in the table, unless the key may do everything."""
    if not key.allows(ADMIN):
        method = scope.get("method", WEBSOCKET)
        raise NotFoundError(f"no route {method} {readable(scope['path'][:200])}: /docs lists all")

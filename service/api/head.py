"""HEAD: as HTTP requires, every address that answers GET answers HEAD with the same status and headers."""

from __future__ import annotations

from collections.abc import Awaitable

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.access.scopes import Rules


class HeadAsGet:
    """Middleware that routes HEAD as GET. The server sends no body in answer to HEAD.

    Event streams are left out, because their answers do not end.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    def __call__(self, scope: Scope, receive: Receive, send: Send) -> Awaitable[None]:
        """Pass the request on. A plain function: a coroutine would take time for every query."""
        if scope.get("method") != "HEAD":
            return self.app(scope, receive, send)
        rules: Rules = scope["app"].state.rules
        rule = rules.of("GET", scope["path"])
        return self.app(scope, receive, send) if rule is None or rule.lasting else self._answer(scope, receive, send)

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        # the server decides by the method whether it sends a body: it is restored before the answer
        def restore(message: Message) -> Awaitable[None]:
            scope["method"] = "HEAD"
            return send(message)

        scope["method"] = "GET"
        try:
            await self.app(scope, receive, restore)
        finally:
            scope["method"] = "HEAD"

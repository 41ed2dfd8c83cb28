"""Adds API keys, scopes and common errors to the OpenAPI document, and the table of all error codes."""

from __future__ import annotations

import hashlib
import re
from base64 import b64encode
from collections.abc import Iterator
from typing import Any

from fastapi import FastAPI
from starlette.datastructures import MutableHeaders
from starlette.routing import Mount
from starlette.routing import Route as StarletteRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.access.scopes import SCOPES, Rules
from service.api.errors import OPEN_INFERENCE, UNEXPECTED_ERROR
from service.foundation import errors
from service.foundation.errors import ServiceError

SCHEME = "key"
DESCRIPTION = "An API key with scopes, `Authorization: Bearer lip_…`:\n\n" + "\n".join(
    f"- `{scope}`: {allows}" for scope, allows in SCOPES.items()
)


POLICY = (
    "default-src 'self'; script-src 'self'{scripts}; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Content security policy: nothing from other hosts, no frames on other sites, only the page's own scripts."""


class Guarded:
    """A page or file of the documentation with a content security policy."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer as the application, which sends pages in one piece, and add the policy."""
        started: Message | None = None

        async def with_policy(message: Message) -> None:
            nonlocal started
            if message["type"] == "http.response.start":
                started = message
                return
            if started is not None:
                headers = MutableHeaders(scope=started)
                html = headers.get("content-type", "").startswith("text/html")
                headers["content-security-policy"] = policy(message.get("body", b"") if html else b"")
                headers["x-content-type-options"] = "nosniff"
                headers["referrer-policy"] = "no-referrer"
                begun, started = started, None
                await send(begun)
            await send(message)

        await self._app(scope, receive, with_policy)


def policy(page: bytes) -> str:
    """Return the policy of one or more pages, which allows their inline scripts by sha256."""
    scripts = sorted(set(re.findall(rb"(?s)<script>(.*?)</script>", page)))
    hashes = (b64encode(hashlib.sha256(each).digest()).decode() for each in scripts)
    return POLICY.format(scripts="".join(f" 'sha256-{each}'" for each in hashes))


def install(app: FastAPI, keys_needed: bool) -> None:
    """Complete the application's OpenAPI document on first use, and add a policy to the pages that show it."""
    pages = ("/docs", "/docs/oauth2-redirect", "/static-offline-docs")
    for route in app.router.routes:
        if isinstance(route, Mount | StarletteRoute) and route.path in pages:
            route.app = Guarded(route.app)
    made = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = made()
            rules = app.state.rules
            _add_errors(document, rules)
            add_scopes(document, rules, keys_needed)
        return made()

    app.openapi = openapi  # type: ignore[method-assign]


def add_scopes(document: dict[str, Any], rules: Rules, keys_needed: bool) -> None:
    """Add the API key scheme to the document, and the needed scope to every operation.

    If not `keys_needed`, requests without a key are allowed as well.
    """
    schemes = document.setdefault("components", {}).setdefault("securitySchemes", {})
    schemes[SCHEME] = {"type": "http", "scheme": "bearer", "description": DESCRIPTION}
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            scope = rules.table[method.upper(), path].scope
            if scope is None:
                operation["security"] = []
                continue
            operation["security"] = [{SCHEME: [scope]}] if keys_needed else [{}, {SCHEME: [scope]}]
            operation["description"] = f"{operation.get('description', '')}\n\nScope: `{scope}`.".strip()


METHODS = ("get", "put", "post", "patch", "delete")
BEFORE_ROUTES = {
    (405, "method_not_allowed"): "The path does not support the method. The header `Allow` lists the supported ones."
}
"""Errors that no route raises, so they have no class."""


def error_table() -> str:
    """Return a Markdown table of all error codes with status and meaning."""
    rows = {(kind.status, kind.code): _meaning(kind) for kind in _below(ServiceError)}
    rows |= BEFORE_ROUTES | {(ServiceError.status, ServiceError.code): _meaning(ServiceError)}
    lines = [f"| {status} | `{code}` | {meaning} |" for (status, code), meaning in sorted(rows.items())]
    return "\n".join(["| status | code | meaning |", "|---|---|---|", *lines]) + "\n"


def _add_errors(document: dict[str, Any], rules: Rules) -> None:
    document["info"]["description"] += f"\n{error_table()}"
    for path, operations in document["paths"].items():
        for method in METHODS:
            if method in operations:
                _add(path, method, operations[method], rules)


def _add(path: str, method: str, operation: dict[str, Any], rules: Rules) -> None:
    """Add the common errors to an operation's responses."""
    kinds: list[type[ServiceError]] = [
        errors.InvalidRequestError,  # for an unknown query parameter
        *(errors.ForbiddenError, errors.RateLimitedError, ServiceError, errors.NotReadyError),
    ]
    if rules.table[method.upper(), path].scope is not None:
        # routes without a key do not use the database
        kinds += (errors.UnauthorizedError, errors.StorageUnavailableError)
    if "requestBody" in operation:
        kinds += (errors.RequestTimeoutError, errors.TooLargeError, errors.UnsupportedMediaTypeError)
    # these POST routes store nothing
    if method != "get" and not path.endswith(
        ("/predict", "/gravity", "/wrench", "/evaluate", "/trace", "/compare", "/echo", "/infer")
    ):
        kinds += (errors.StorageFullError,)
    protocol = f"{path}/".startswith(f"{OPEN_INFERENCE}/")
    answers = operation["responses"]
    own = set(answers)
    for kind in kinds:
        status = str(400 if protocol and kind.status == 422 else kind.status)
        meaning = _meaning(kind) if protocol else f"`{kind.code}`: {_meaning(kind)}"
        answer = answers.setdefault(status, _answer("Failure" if protocol else "ErrorResponse"))
        if status not in own or (not protocol and f"`{kind.code}`" not in answer["description"]):
            answer["description"] = f"{answer['description']} {meaning}".strip()
    for status, answer in answers.items():
        if int(status) >= 400:  # FastAPI sets the media type of the successful answer
            (schema,) = answer["content"].values()
            answer["content"] = {"application/json": schema}
    operation["responses"] = dict(sorted(answers.items()))


def _answer(schema: str) -> dict[str, Any]:
    content = {"application/json": {"schema": {"$ref": f"#/components/schemas/{schema}"}}}
    return {"description": "", "content": content}


def _meaning(kind: type[ServiceError]) -> str:
    if kind is ServiceError:
        return UNEXPECTED_ERROR
    return " ".join((kind.__doc__ or "").split())


def _below(kind: type[ServiceError]) -> Iterator[type[ServiceError]]:
    for below in kind.__subclasses__():
        yield below
        yield from _below(below)

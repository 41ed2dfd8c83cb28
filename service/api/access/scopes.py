"""Scopes of API keys, and the scope that each route needs."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar
from urllib.parse import parse_qsl

from fastapi.routing import iter_route_contexts
from starlette.routing import BaseRoute

READ, PREDICT, UPDATE, TRAIN, ADMIN = "read", "predict", "update", "train", "admin"
SCOPES = {
    READ: "list and read data sets, robots, jobs, models, quality and metrics; export models",
    PREDICT: "predict torque over HTTP and streams; evaluate, trace and compare models on data sets",
    UPDATE: "send observations and torque in streams to learn from; unlearn and replay observation batches",
    TRAIN: "upload and delete data sets and robots; start, cancel and retry training jobs",
    ADMIN: "everything, including what no other scope allows: move aliases, delete models, set learning options",
}
"""The scopes and what they allow. Only `admin` includes other scopes."""

WEBSOCKET = "WEBSOCKET"
"""Stands in for the method of a WebSocket."""
MAX_PATH_CHARS = 1000
"""Far longer than the path of any route. Longer paths are not looked up or cached."""


class Rule(NamedTuple):
    """What a route needs: a scope, or None if no key. A `lasting` answer is a stream that ends with the key."""

    scope: str | None
    lasting: bool = False


Endpoint = TypeVar("Endpoint", bound=Callable[..., Any])


def needs(scope: str | None, lasting: bool = False) -> Callable[[Endpoint], Endpoint]:
    """Declare the rule of an endpoint's route; see `Rule`."""

    def declare(endpoint: Endpoint) -> Endpoint:
        endpoint.rule = Rule(scope, lasting)  # type: ignore[attr-defined]
        return endpoint

    return declare


class Rules:
    """The rules of an application's routes; `table`: by method and path as in the OpenAPI document.

    Raise RuntimeError for a route without a rule.
    """

    def __init__(self, routes: Sequence[BaseRoute]) -> None:
        self.table: dict[tuple[str, str], Rule] = {}
        self._patterns: dict[str, list[tuple[re.Pattern[str], Rule]]] = {}
        for methods, path, pattern, rule in _declared(routes):
            for method in methods:
                self.table[method, path] = rule
                self._patterns.setdefault(method, []).append((pattern, rule))
        self._find = lru_cache(1024)(self._search)

    def of(self, method: str, path: str) -> Rule | None:
        """Return the rule of a request, None if there is no such route."""
        return self._find(method, path) if len(path) <= MAX_PATH_CHARS else None

    def _search(self, method: str, path: str) -> Rule | None:
        method = "GET" if method == "HEAD" else method
        return next((rule for pattern, rule in self._patterns.get(method, ()) if pattern.match(path)), None)


def _declared(routes: Sequence[BaseRoute]) -> Iterator[tuple[Sequence[str], str, re.Pattern[str], Rule]]:
    """Yield the methods, path, path pattern and rule of every route."""
    for route in iter_route_contexts(routes):
        calls: dict[str, Rule] | None = getattr(route.original_route, "calls", None)
        if calls is not None:
            for call, needed in calls.items():
                yield ("POST",), call, re.compile(re.escape(call) + r"\Z"), needed
            continue
        path, pattern = str(route.path), route.path_regex
        # pages and their files are not part of the API and need no key
        if path in ("/", "/openapi.json") or path.startswith(("/docs", "/static-offline-docs", "/dashboard", "/guide")):
            yield ("GET",), path, pattern, Rule(None)
            continue
        rule = getattr(route.endpoint, "rule", None)
        if not isinstance(rule, Rule):
            raise RuntimeError(f"route {path} has no scope: declare it with @needs(…)")
        yield sorted(getattr(route, "methods", None) or {WEBSOCKET}), path, pattern, rule


def scopes_of_stream(query: bytes) -> tuple[str, ...]:
    """Return the scopes that a stream needs. With `stream_id` it also sends torque to learn from."""
    given = parse_qsl(query.decode("ascii", "replace"), keep_blank_values=True)
    return (PREDICT, UPDATE) if any(name == "stream_id" for name, _ in given) else (PREDICT,)

"""What an API key has to be allowed for each route, which says so where it is declared."""

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
    READ: "list and look: data sets, robots, jobs, models, quality, metrics; export a model",
    PREDICT: "ask for torques, over HTTP and streams; evaluate, trace and compare models on data sets",
    UPDATE: "teach: send observations and torque in streams, unlearn and replay them",
    TRAIN: "upload and delete data sets and robots; start, cancel and repeat training jobs",
    ADMIN: "everything, also what no other scope allows: move aliases, delete models, set how they learn",
}
"""Each scope and what it allows. Only `admin` implies others."""

WEBSOCKET = "WEBSOCKET"
"""Stands for the method of a WebSocket, which has none."""
LONGEST_PATH = 1000
"""Far beyond that of any route: what is longer is not kept for the next request."""


class Rule(NamedTuple):
    """What a route needs. scope: None where it needs no key; lasting: its answer goes on for long, and ends with the
    key."""

    scope: str | None
    lasting: bool = False


Endpoint = TypeVar("Endpoint", bound=Callable[..., Any])


def needs(scope: str | None, lasting: bool = False) -> Callable[[Endpoint], Endpoint]:
    """Declare what the route of an endpoint needs; see `Rule`."""

    def declare(endpoint: Endpoint) -> Endpoint:
        endpoint.rule = Rule(scope, lasting)  # type: ignore[attr-defined]
        return endpoint

    return declare


class Rules:
    """What the routes of an application need. table: by method and path as in the OpenAPI document.

    Raise RuntimeError for a route that does not say it.
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
        """Return the rule of a request, None where there is no such route."""
        return self._find(method, path) if len(path) <= LONGEST_PATH else None

    def _search(self, method: str, path: str) -> Rule | None:
        method = "GET" if method == "HEAD" else method
        return next((rule for pattern, rule in self._patterns.get(method, ()) if pattern.match(path)), None)


def _declared(routes: Sequence[BaseRoute]) -> Iterator[tuple[Sequence[str], str, re.Pattern[str], Rule]]:
    """Methods, path, the pattern by which it is routed, and the rule of every route."""
    for route in iter_route_contexts(routes):
        calls: dict[str, Rule] | None = getattr(route.original_route, "calls", None)
        if calls is not None:
            for call, needed in calls.items():
                yield ("POST",), call, re.compile(re.escape(call) + r"\Z"), needed
            continue
        path, pattern = str(route.path), route.path_regex
        # pages and their files, which are no part of the API, are shown without a key
        if path in ("/", "/openapi.json") or path.startswith(("/docs", "/static-offline-docs", "/dashboard", "/guide")):
            yield ("GET",), path, pattern, Rule(None)
            continue
        rule = getattr(route.endpoint, "rule", None)
        if not isinstance(rule, Rule):
            raise RuntimeError(f"the route {path} does not say which scope it needs: declare it with @needs(…)")
        yield sorted(getattr(route, "methods", None) or {WEBSOCKET}), path, pattern, rule


def scopes_of_stream(query: bytes) -> tuple[str, ...]:
    """Return the scopes that a stream needs: one that names a source of torque to learn from teaches as well."""
    given = parse_qsl(query.decode("ascii", "replace"), keep_blank_values=True)
    return (PREDICT, UPDATE) if any(name == "stream_id" for name, _ in given) else (PREDICT,)

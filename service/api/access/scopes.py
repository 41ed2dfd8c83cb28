"""What an API key has to be allowed for each route: the one table of it."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import NamedTuple
from urllib.parse import parse_qsl

from starlette.routing import compile_path

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
STREAM = "/v1/models/{model}/stream"
CALLS = "/inference.GRPCInferenceService/"
"""Paths of gRPC's calls begin so."""

TABLE: dict[tuple[str, str], str] = {
    ("GET", "/metrics"): READ,
    ("GET", "/v1/audit"): ADMIN,
    ("POST", "/v1/datasets"): TRAIN,
    ("GET", "/v1/datasets"): READ,
    ("GET", "/v1/datasets/{dataset}"): READ,
    ("GET", "/v1/datasets/{dataset}/preview"): READ,
    ("DELETE", "/v1/datasets/{dataset}"): TRAIN,
    ("POST", "/v1/robots"): TRAIN,
    ("GET", "/v1/robots"): READ,
    ("GET", "/v1/robots/profiles"): READ,
    ("GET", "/v1/robots/profiles/{name}"): READ,
    ("GET", "/v1/robots/{robot}"): READ,
    ("DELETE", "/v1/robots/{robot}"): TRAIN,
    ("POST", "/v1/jobs"): TRAIN,
    ("POST", "/v1/jobs/check"): TRAIN,
    ("GET", "/v1/jobs"): READ,
    ("GET", "/v1/jobs/{job}"): READ,
    ("GET", "/v1/jobs/{job}/events"): READ,
    ("POST", "/v1/jobs/{job}/cancel"): TRAIN,
    ("POST", "/v1/jobs/{job}/retry"): TRAIN,
    ("GET", "/v1/overview"): READ,
    ("GET", "/v1/models"): READ,
    ("POST", "/v1/models/import"): ADMIN,
    ("GET", "/v1/models/{model}"): READ,
    ("DELETE", "/v1/models/{model}"): ADMIN,
    ("GET", "/v1/models/{model}/export"): READ,
    ("GET", "/v1/models/{model}/urdf"): READ,
    ("GET", "/v1/models/{model}/versions/{version}"): READ,
    ("DELETE", "/v1/models/{model}/versions/{version}"): ADMIN,
    ("GET", "/v1/models/{model}/aliases"): READ,
    ("PUT", "/v1/models/{model}/aliases/{alias}"): ADMIN,
    ("DELETE", "/v1/models/{model}/aliases/{alias}"): ADMIN,
    ("POST", "/v1/models/{model}/aliases/{alias}/rollback"): ADMIN,
    ("POST", "/v1/models/{model}/predict"): PREDICT,
    ("POST", "/v1/models/{model}/evaluate"): PREDICT,
    ("POST", "/v1/models/{model}/trace"): PREDICT,
    ("POST", "/v1/models/{model}/compare"): PREDICT,
    (WEBSOCKET, STREAM): PREDICT,
    ("POST", "/v1/models/{model}/observations"): UPDATE,
    ("GET", "/v1/models/{model}/observations"): READ,
    ("GET", "/v1/models/{model}/observations/{stream_id}/{sequence}"): READ,
    ("DELETE", "/v1/models/{model}/observations/{stream_id}/{sequence}"): UPDATE,
    ("POST", "/v1/models/{model}/observations/{stream_id}/{sequence}/replay"): UPDATE,
    ("POST", "/v1/models/{model}/rollback"): ADMIN,
    ("POST", "/v1/models/{model}/refresh"): TRAIN,
    ("GET", "/v1/models/{model}/quality"): READ,
    ("GET", "/v1/models/{model}/learning"): READ,
    ("PUT", "/v1/models/{model}/learning"): ADMIN,
    ("POST", "/v1/models/{model}/learning/change"): ADMIN,
    ("GET", "/v1/models/{model}/payload"): READ,
    ("PUT", "/v1/models/{model}/payload"): UPDATE,
    ("DELETE", "/v1/models/{model}/payload"): UPDATE,
    ("DELETE", "/v1/models/{model}/streams/{stream_id}"): UPDATE,
    ("GET", "/v1/models/{model}/alarms"): READ,
    ("GET", "/v1/models/{model}/live"): READ,
    ("POST", "/v1/echo"): PREDICT,
    (WEBSOCKET, "/v1/echo/stream"): PREDICT,
    ("GET", "/v2"): READ,
    ("GET", "/v2/models/{model}"): READ,
    ("GET", "/v2/models/{model}/ready"): READ,
    ("GET", "/v2/models/{model}/versions/{version}"): READ,
    ("GET", "/v2/models/{model}/versions/{version}/ready"): READ,
    ("POST", "/v2/models/{model}/infer"): PREDICT,
    ("POST", "/v2/models/{model}/versions/{version}/infer"): PREDICT,
    ("POST", f"{CALLS}ServerMetadata"): READ,
    ("POST", f"{CALLS}ModelReady"): READ,
    ("POST", f"{CALLS}ModelMetadata"): READ,
    ("POST", f"{CALLS}ModelInfer"): PREDICT,
}
"""(method, path as in the OpenAPI document) of each route that needs a key, and the scope it needs."""

OPEN: frozenset[tuple[str, str]] = frozenset(
    ("GET", path)
    for path in (
        "/health",
        "/health/live",
        "/health/ready",
        "/v2/health/live",
        "/v2/health/ready",
        "/docs",
        "/docs/oauth2-redirect",
        "/openapi.json",
        "/static-offline-docs/{file:path}",
        "/",
        "/dashboard/{file:path}",
        "/guide",
        "/guide/{page}",
        "/guide/files/{name}",
    )
) | {("POST", f"{CALLS}ServerLive"), ("POST", f"{CALLS}ServerReady")}
"""Routes without a key: health, for what watches over the service, documentation, guide, and the dashboard's files."""

LONGEST_PATH = 1000
"""Far beyond that of any route: what is longer is not kept for the next request."""
LASTING = frozenset(
    {
        ("GET", "/v1/jobs/{job}/events"),
        ("GET", "/v1/models/{model}/live"),
        (WEBSOCKET, STREAM),
        (WEBSOCKET, "/v1/echo/stream"),
    }
)
"""Routes that go on answering for long: they end when the key does."""


class Rule(NamedTuple):
    """What a route needs. scopes: all of them, none where it needs no key; lasting: its answer ends with the key."""

    scopes: tuple[str, ...]
    lasting: bool


def rule_of(method: str, path: str) -> Rule | None:
    """Return the rule of a request, None where there is no such route."""
    return _rule(method, path) if len(path) <= LONGEST_PATH else None


@lru_cache(1024)
def _rule(method: str, path: str) -> Rule | None:
    method = "GET" if method == "HEAD" else method
    return next((rule for rule, pattern in _patterns().get(method, ()) if pattern.match(path)), None)


def scopes_of_stream(query: bytes) -> tuple[str, ...]:
    """Return the scopes that a stream needs: one that names a source of torque to learn from teaches as well."""
    given = parse_qsl(query.decode("ascii", "replace"), keep_blank_values=True)
    return (PREDICT, UPDATE) if any(name == "stream_id" for name, _ in given) else (PREDICT,)


@lru_cache(1)
def _patterns() -> dict[str, list[tuple[Rule, re.Pattern[str]]]]:
    """Rules by method, each with the pattern that Starlette matches paths with: what it routes is what is checked."""
    patterns: dict[str, list[tuple[Rule, re.Pattern[str]]]] = {}
    for route in (*TABLE, *OPEN):
        method, path = route
        rule = Rule((TABLE[route],) if route in TABLE else (), route in LASTING)
        patterns.setdefault(method, []).append((rule, compile_path(path)[0]))
    return patterns

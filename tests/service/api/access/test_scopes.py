"""Scopes: the table of routes is complete, and the service enforces it."""

import re

import pytest
from fastapi import FastAPI

from service.api.access.scopes import ADMIN, MAX_PATH_CHARS, SCOPES, WEBSOCKET, Rules
from service.api.oip.rpc.methods import METHODS as CALLS
from service.app import create_app
from service.foundation.settings import Settings
from tests.service.api.access.conftest import bearer
from tests.service.data import error

RULES: Rules = create_app(Settings(grpc_port=0)).state.rules
HTTP = sorted(
    (method, path)
    for (method, path), rule in RULES.table.items()
    if method != WEBSOCKET and rule.scope is not None and path not in CALLS
)


def address(path: str) -> str:
    """Return an address of the route at which nothing exists."""
    return re.sub(r"\{\w+\}", "0", path)


def request(service, method, path, scope):
    """Send a request with the key of a scope."""
    return service.api.request(method, path, headers=bearer(service.secrets[scope]))


def test_route_without_a_scope_prevents_the_start():
    app = FastAPI(docs_url=None, redoc_url=None)
    app.get("/v1/forgotten")(lambda: None)
    with pytest.raises(RuntimeError, match=r"route /v1/forgotten has no scope"):
        Rules(app.routes)


def test_changes_need_more_than_the_scope_read():
    """A key that may only read can send queries and change nothing."""
    assert {rule.scope for rule in RULES.table.values()} == {None, *SCOPES}
    calls = {path for path in CALLS if not path.endswith(("ServerLive", "ServerReady", "ModelInfer"))}
    assert {path for (method, path), rule in RULES.table.items() if rule.scope == "read" and method != "GET"} == {
        *calls,
        "/v2/repository/index",
        *(f"/v2/repository/models/{{model}}/{action}" for action in ("load", "unload")),  # always refused
    }
    assert {path for (_, path), rule in RULES.table.items() if rule.scope is None} >= {"/", "/docs", "/health/live"}
    assert {path for (_, path), rule in RULES.table.items() if rule.lasting} == {
        "/v1/echo/stream",
        "/v1/jobs/{job}/events",
        "/v1/models/{model}/live",
        "/v1/models/{model}/stream",
    }


@pytest.mark.parametrize("scope", SCOPES)
def test_key_is_allowed_exactly_its_scope(keyed_service, scope):
    assert len(HTTP) > 40
    for method, path in HTTP:
        needed = RULES.table[method, path].scope
        answer = request(keyed_service, method, address(path), scope)
        if scope in (needed, ADMIN):
            assert answer.status_code not in (401, 403), (method, path, answer.text)
        else:
            assert answer.status_code == 403, (method, path, answer.text)
            assert f'scope="{needed}"' in answer.headers["www-authenticate"]
            assert f"lacks the scope {needed}." in answer.text


def test_requests_without_a_key_are_rejected(keyed_service):
    for method, path in HTTP:
        answer = keyed_service.api.request(method, address(path))
        assert answer.status_code == 401, (method, path, answer.text)
        assert answer.headers["www-authenticate"].startswith("Bearer")


def test_health_and_documentation_need_no_key(keyed_service):
    page = keyed_service.api.get("/docs").text
    assets = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert len(assets) >= 2
    health = ("/health/live", "/health/ready", "/v2/health/live", "/v2/health/ready")
    for path in (*health, "/docs", "/openapi.json", *assets):
        assert keyed_service.api.get(path).status_code == 200, path


PLAIN = ["/nothing", "/dashboard", "/v1/models/", "/V1/models", "/health/", "/docs/", "/v1/" + "m" * MAX_PATH_CHARS]
ODD = ["//v1/models", "/v1%2fmodels", "/v1/models%00", "/v1/models;x", "/v1/models%0a", "/openapi.json/v1/models"]
UPWARDS = ["/health/../v1/models", "/health/%2e%2e/v1/models", "/docs/../v1/models", "/dashboard/../v1/models"]
UPWARDS += ["/static-offline-docs/../v1/models", "/static-offline-docs/%2e%2e/%2e%2e/v1/models"]


@pytest.mark.each_once
@pytest.mark.parametrize("path", [*PLAIN, *ODD, *UPWARDS])
@pytest.mark.parametrize("method", ["GET", "HEAD", "POST", "OPTIONS", "PROPFIND"])
def test_no_address_bypasses_the_keys(keyed_service, method, path):
    answer = keyed_service.api.request(method, path)
    # a path of a folder, which serves nothing else
    inside = path.startswith(("/static", "/dashboard/")) and method in ("GET", "HEAD")
    assert answer.status_code in ((401, 404) if inside else (401,)), answer.text


def test_unlisted_routes_are_for_admins_only(keyed_service):
    for method, path in (("PATCH", "/v1/models"), ("GET", "/v1/nothing"), ("POST", "/health/live")):
        for scope in set(SCOPES) - {ADMIN}:
            refusal = error(request(keyed_service, method, path, scope), 404, "not_found")
            assert f"no route {method} {path}" in refusal["message"]
        assert request(keyed_service, method, path, ADMIN).status_code in (404, 405)


def test_head_needs_the_scope_of_get():
    assert RULES.of("HEAD", "/v1/models") == RULES.of("GET", "/v1/models")
    assert RULES.of("HEAD", "/v1/models").scope == "read"


def test_openapi_names_the_scope_of_each_operation(api, keyed_service):
    free, locked = (client.get("/openapi.json").json() for client in (api, keyed_service.api))
    for document in (free, locked):
        scheme = document["components"]["securitySchemes"]["key"]
        assert (scheme["type"], scheme["scheme"]) == ("http", "bearer")
        assert all(f"`{scope}`" in scheme["description"] for scope in SCOPES)
    for method, path in HTTP:
        scope = RULES.table[method, path].scope
        if path in free["paths"]:
            operations = [document["paths"][path][method.lower()] for document in (free, locked)]
            assert [each["security"] for each in operations] == [[{}, {"key": [scope]}], [{"key": [scope]}]]
            assert all(each["description"].endswith(f"Scope: `{scope}`.") for each in operations)
    assert locked["paths"]["/health/live"]["get"]["security"] == []

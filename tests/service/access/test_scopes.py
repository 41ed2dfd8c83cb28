"""Which key may do what: the table is complete, and it is what the service goes by."""

import re

import pytest

from service.api.access.scopes import ADMIN, LASTING, LONGEST_PATH, OPEN, SCOPES, TABLE, WEBSOCKET, rule_of
from service.api.oip.rpc.methods import METHODS as CALLS
from service.api.stream import routes as stream
from tests.service.access.conftest import bearer
from tests.service.data import error

HTTP = sorted(route for route in TABLE if route[0] != WEBSOCKET)
METHODS = ("get", "post", "put", "patch", "delete")
PAGES = {"/", "/dashboard/{file:path}", "/docs", "/docs/oauth2-redirect", "/static-offline-docs/{file:path}"}
PAGES |= {"/guide", "/guide/{page}", "/guide/files/{name}", "/openapi.json"}
"""Open routes that the OpenAPI document leaves out."""


def address(path: str) -> str:
    """An address of the route at which there is nothing."""
    return re.sub(r"\{\w+\}", "0", path)


def test_every_route_is_in_the_table_and_nothing_else(api):
    documented = {
        (method.upper(), path)
        for path, operations in api.get("/openapi.json").json()["paths"].items()
        for method in operations
        if method in METHODS
    }
    streams = {(WEBSOCKET, stream.PATH), (WEBSOCKET, stream.ECHO_PATH)}
    assert not set(TABLE) & OPEN
    calls = {("POST", path) for path in CALLS}
    assert documented | streams | calls == set(TABLE) | {route for route in OPEN if route[1] not in PAGES}
    assert set(TABLE.values()) == set(SCOPES)
    assert set(TABLE) > LASTING


@pytest.mark.parametrize("scope", SCOPES)
def test_a_key_may_do_what_its_scope_allows_and_nothing_else(guarded, scope):
    assert len(HTTP) > 40
    for method, path in HTTP:
        needed = TABLE[method, path]
        answer = guarded.api.request(method, address(path), headers=bearer(guarded.secrets[scope]))
        if scope in (needed, ADMIN):
            assert answer.status_code not in (401, 403), (method, path, answer.text)
        else:
            assert answer.status_code == 403, (method, path, answer.text)
            assert f'scope="{needed}"' in answer.headers["www-authenticate"]
            assert f"this needs {needed}" in answer.text


def test_nothing_is_answered_without_a_key(guarded):
    for method, path in HTTP:
        answer = guarded.api.request(method, address(path))
        assert answer.status_code == 401, (method, path, answer.text)
        assert answer.headers["www-authenticate"].startswith("Bearer")


def test_health_and_documentation_are_open(guarded):
    page = guarded.api.get("/docs").text
    assets = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert len(assets) >= 2
    health = ("/health/live", "/health/ready", "/v2/health/live", "/v2/health/ready")
    for path in (*health, "/docs", "/openapi.json", *assets):
        assert guarded.api.get(path).status_code == 200, path


PLAIN = ["/nothing", "/dashboard", "/v1/models/", "/V1/models", "/health", "/docs/", "/v1/" + "m" * LONGEST_PATH]
ODD = ["//v1/models", "/v1%2fmodels", "/v1/models%00", "/v1/models;x", "/v1/models%0a", "/openapi.json/v1/models"]
UPWARDS = ["/health/../v1/models", "/health/%2e%2e/v1/models", "/docs/../v1/models", "/dashboard/../v1/models"]
UPWARDS += ["/static-offline-docs/../v1/models", "/static-offline-docs/%2e%2e/%2e%2e/v1/models"]


@pytest.mark.each_once
@pytest.mark.parametrize("path", [*PLAIN, *ODD, *UPWARDS])
@pytest.mark.parametrize("method", ["GET", "HEAD", "POST", "OPTIONS", "PROPFIND"])
def test_no_address_leads_around_the_keys(guarded, method, path):
    answer = guarded.api.request(method, path)
    # of a folder, as which nothing else is served
    inside = path.startswith(("/static", "/dashboard/")) and method in ("GET", "HEAD")
    assert answer.status_code in ((401, 404) if inside else (401,)), answer.text


def test_routes_that_are_not_in_the_table_are_for_admins_only(guarded):
    for method, path in (("PATCH", "/v1/models"), ("GET", "/v1/nothing"), ("POST", "/health/live")):
        for scope in set(SCOPES) - {ADMIN}:
            refusal = error(guarded.api.request(method, path, headers=bearer(guarded.secrets[scope])), 404, "not_found")
            assert f"no route {method} {path}" in refusal["message"]
        answer = guarded.api.request(method, path, headers=bearer(guarded.secrets[ADMIN]))
        assert answer.status_code in (404, 405)


def test_head_needs_what_get_needs():
    assert rule_of("HEAD", "/v1/models") == rule_of("GET", "/v1/models")
    assert rule_of("HEAD", "/v1/models").scopes == ("read",)


def test_the_document_says_which_scope_an_operation_needs(api, guarded):
    free, locked = (client.get("/openapi.json").json() for client in (api, guarded.api))
    for document in (free, locked):
        scheme = document["components"]["securitySchemes"]["key"]
        assert (scheme["type"], scheme["scheme"]) == ("http", "bearer")
        assert all(f"`{scope}`" in scheme["description"] for scope in SCOPES)
    for (method, path), scope in TABLE.items():
        if method != WEBSOCKET and path not in CALLS:
            operations = [document["paths"][path][method.lower()] for document in (free, locked)]
            assert [each["security"] for each in operations] == [[{}, {"key": [scope]}], [{"key": [scope]}]]
            assert all(each["description"].endswith(f"Scope: `{scope}`.") for each in operations)
    assert locked["paths"]["/health/live"]["get"]["security"] == []

"""Which key may do what: the table is complete, and it is what the service goes by."""

import re

import pytest
from fastapi import FastAPI

from service.api.access.scopes import ADMIN, LONGEST_PATH, SCOPES, WEBSOCKET, Rules
from service.api.oip.rpc.methods import METHODS as CALLS
from service.app import create_app
from service.foundation.settings import Settings
from tests.service.access.conftest import bearer
from tests.service.data import error

RULES: Rules = create_app(Settings(grpc_port=0)).state.rules
HTTP = sorted(
    (method, path)
    for (method, path), rule in RULES.table.items()
    if method != WEBSOCKET and rule.scope is not None and path not in CALLS
)


def address(path: str) -> str:
    """An address of the route at which there is nothing."""
    return re.sub(r"\{\w+\}", "0", path)


def test_a_route_that_does_not_say_what_it_needs_stops_the_start():
    app = FastAPI(docs_url=None, redoc_url=None)
    app.get("/v1/forgotten")(lambda: None)
    with pytest.raises(RuntimeError, match=r"the route /v1/forgotten does not say which scope it needs"):
        Rules(app.routes)


def test_changes_are_for_those_who_may_make_them():
    """What a key that may only read cannot do: nothing but questions."""
    assert {rule.scope for rule in RULES.table.values()} == {None, *SCOPES}
    assert {path for (method, path), rule in RULES.table.items() if rule.scope == "read" and method != "GET"} == {
        f"/inference.GRPCInferenceService/{name}" for name in ("ServerMetadata", "ModelReady", "ModelMetadata")
    }
    assert {path for (_, path), rule in RULES.table.items() if rule.scope is None} >= {"/", "/docs", "/health/live"}
    assert {path for (_, path), rule in RULES.table.items() if rule.lasting} == {
        "/v1/echo/stream",
        "/v1/jobs/{job}/events",
        "/v1/models/{model}/live",
        "/v1/models/{model}/stream",
    }


@pytest.mark.parametrize("scope", SCOPES)
def test_a_key_may_do_what_its_scope_allows_and_nothing_else(guarded, scope):
    assert len(HTTP) > 40
    for method, path in HTTP:
        needed = RULES.table[method, path].scope
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


PLAIN = ["/nothing", "/dashboard", "/v1/models/", "/V1/models", "/health/", "/docs/", "/v1/" + "m" * LONGEST_PATH]
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
    assert RULES.of("HEAD", "/v1/models") == RULES.of("GET", "/v1/models")
    assert RULES.of("HEAD", "/v1/models").scope == "read"


def test_the_document_says_which_scope_an_operation_needs(api, guarded):
    free, locked = (client.get("/openapi.json").json() for client in (api, guarded.api))
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

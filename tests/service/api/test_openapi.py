"""The OpenAPI document is complete and describes what the service answers."""

import hashlib
import re
from base64 import b64encode

import numpy as np
import pytest

METHODS = ("get", "post", "put", "patch", "delete")
ERROR = {"$ref": "#/components/schemas/ErrorResponse"}
FAILURE = {"$ref": "#/components/schemas/Failure"}
INFER = ("POST /v2/models/{model}/infer", "POST /v2/models/{model}/versions/{version}/infer")


@pytest.fixture(scope="module")
def document(api):
    return api.get("/openapi.json").json()


@pytest.fixture(scope="module")
def operations(document):
    return {
        f"{method.upper()} {path}": operation
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
        if method in METHODS
    }


def references(node):
    """Yield every $ref below a node."""
    if isinstance(node, dict):
        if "$ref" in node:
            yield node["$ref"]
        for value in node.values():
            yield from references(value)
    elif isinstance(node, list):
        for value in node:
            yield from references(value)


def test_every_schema_is_used(document):
    used = {reference.rpartition("/")[2] for reference in references(document)}
    assert set(document["components"]["schemas"]) == used


def test_document_has_the_required_structure(document, operations):
    assert document["openapi"].startswith("3.")
    assert document["info"]["title"] == "LIPServe"
    ids = [operation["operationId"] for operation in operations.values()]
    assert len(set(ids)) == len(ids)
    for name, operation in operations.items():
        declared = {item["name"] for item in operation.get("parameters", []) if item["in"] == "path"}
        in_path = {part.strip("{}") for part in name.split("/") if part.startswith("{")}
        assert declared == in_path, name
        for status, response in operation["responses"].items():
            assert 200 <= int(status) < 600
            assert response["description"], (name, status)


def test_every_route_has_a_description(operations):
    for name, operation in operations.items():
        assert all(operation[field] for field in ("tags", "summary", "description")), name
        assert operation["description"] != operation["summary"], name
        for item in operation.get("parameters", []):
            assert "schema" in item, (name, item["name"])
            assert item["in"] == "path" or item["description"], (name, item["name"])


def test_documented_errors_have_the_same_shape(operations):
    for name, operation in operations.items():
        errors = {status: response for status, response in operation["responses"].items() if int(status) >= 400}
        of_v2 = " /v2" in name
        for status, response in errors.items():
            schema = FAILURE if of_v2 else ERROR
            assert response["content"] == {"application/json": {"schema": schema}}, (name, status)
            assert of_v2 or response["description"].startswith("`"), (name, status)


def test_common_errors_are_documented_at_every_route(operations):
    for name, operation in operations.items():
        answered = set(operation["responses"])
        wrong = "400" if " /v2" in name else "422"
        assert {wrong, "403", "429", "500", "503"} <= answered, name
        assert ("401" in answered) != name.endswith(("/health", "/health/live", "/health/ready")), name
        assert ("requestBody" in operation) == ("408" in answered) == ("413" in answered) == ("415" in answered), name
        stores = not name.startswith("GET") and not name.endswith(
            ("/predict", "/gravity", "/wrench", "/evaluate", "/trace", "/compare", "/echo", "/infer")
        )
        assert ("507" in answered) == stores, name


def test_requests_have_examples(document, operations):
    for name, operation in operations.items():
        if (body := operation.get("requestBody")) is None:
            continue
        assert body["required"] is True
        media = next(iter(body["content"].values()))
        schema = media["schema"]
        if "$ref" in schema:
            schema = document["components"]["schemas"][schema["$ref"].removeprefix("#/components/schemas/")]
        binary = schema.get("format") == "binary"  # an archive is binary and has no example
        assert media.get("example") or schema.get("examples") or binary, name


def test_example_of_a_query_is_answered(api, document):
    (example,) = document["components"]["schemas"]["PredictRequest"]["examples"]
    assert api.post("/v1/models/panda-sim/predict", json=example).status_code == 200


@pytest.mark.parametrize("operation", INFER)
def test_example_of_an_inference_is_answered_as_documented(api, operations, operation):
    documented = operations[operation]
    answered = documented["responses"]["200"]["content"]
    asked = documented["requestBody"]["content"]
    assert set(asked) == set(answered) == {"application/json", "application/octet-stream"}
    path = operation.removeprefix("POST ").format(model="panda-sim", version=1)
    answer = api.post(path, json=asked["application/json"]["example"])
    assert answer.status_code == 200, answer.text
    result, expected = answer.json(), answered["application/json"]["example"]
    numbers, view = ([each.pop("data") for each in body["outputs"]] for body in (result, expected))
    assert result == expected
    assert np.allclose(numbers, view, atol=0.1)


DASHBOARD = ("/", "/dashboard/app.js", "/dashboard/plotly/cartesian.js")
DOCUMENTATION = ("/docs", "/docs/oauth2-redirect", "/static-offline-docs/swagger-ui-bundle.js")


@pytest.mark.parametrize("path", [*DASHBOARD, *DOCUMENTATION])
def test_pages_run_only_their_scripts_and_are_not_framed(api, path):
    answer = api.get(path)
    policy = dict(each.strip().split(" ", 1) for each in answer.headers["content-security-policy"].split(";"))
    assert policy["default-src"] == "'self'"
    assert policy["frame-ancestors"] == "'none'"
    assert answer.headers["x-content-type-options"] == "nosniff"
    if path in DASHBOARD:
        assert "script-src" not in policy
        return
    assert policy["base-uri"] == "'none'"
    scripts = re.findall(r"<script>(.*?)</script>", answer.text, re.DOTALL) if path.startswith("/docs") else []
    hashes = [f"'sha256-{b64encode(hashlib.sha256(each.encode()).digest()).decode()}'" for each in scripts]
    assert policy["script-src"].split() == ["'self'", *hashes]


def test_documentation_loads_nothing_from_other_hosts(api):
    page = api.get("/docs").text
    assert "https://" not in page
    assert "http://" not in page

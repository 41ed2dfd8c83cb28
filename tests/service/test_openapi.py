"""The OpenAPI document: complete, and true to what the service answers."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from service.datasets.asking import MEDIA_TYPES

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
    """Every $ref below a node."""
    if isinstance(node, dict):
        if "$ref" in node:
            yield node["$ref"]
        for value in node.values():
            yield from references(value)
    elif isinstance(node, list):
        for value in node:
            yield from references(value)


def resolve(document, reference):
    assert reference.startswith("#/"), reference
    for part in reference[2:].split("/"):
        document = document[part]
    return document


def test_every_route_of_the_design_is_there(operations):
    assert set(operations) == {
        "GET /health/live",
        "GET /health/ready",
        "POST /v1/datasets",
        "GET /v1/datasets",
        "GET /v1/datasets/{dataset}",
        "GET /v1/datasets/{dataset}/preview",
        "DELETE /v1/datasets/{dataset}",
        "POST /v1/robots",
        "GET /v1/robots",
        "GET /v1/robots/profiles",
        "GET /v1/robots/profiles/{name}",
        "GET /v1/robots/{robot}",
        "DELETE /v1/robots/{robot}",
        "POST /v1/jobs",
        "GET /v1/jobs",
        "GET /v1/jobs/{job}",
        "POST /v1/jobs/{job}/cancel",
        "GET /v1/jobs/{job}/events",
        "POST /v1/jobs/{job}/retry",
        "GET /v1/models",
        "GET /v1/models/{model}",
        "DELETE /v1/models/{model}",
        "GET /v1/models/{model}/versions/{version}",
        "DELETE /v1/models/{model}/versions/{version}",
        "GET /v1/models/{model}/aliases",
        "PUT /v1/models/{model}/aliases/{alias}",
        "DELETE /v1/models/{model}/aliases/{alias}",
        "POST /v1/models/{model}/aliases/{alias}/rollback",
        "POST /v1/models/{model}/trace",
        "POST /v1/models/{model}/compare",
        "GET /v1/models/{model}/export",
        "GET /v1/models/{model}/urdf",
        "POST /v1/models/import",
        "POST /v1/models/{model}/predict",
        "POST /v1/models/{model}/evaluate",
        "POST /v1/models/{model}/observations",
        "GET /v1/models/{model}/observations",
        "GET /v1/models/{model}/observations/{stream_id}/{sequence}",
        "DELETE /v1/models/{model}/observations/{stream_id}/{sequence}",
        "POST /v1/models/{model}/observations/{stream_id}/{sequence}/replay",
        "POST /v1/models/{model}/rollback",
        "POST /v1/models/{model}/refresh",
        "GET /v1/models/{model}/quality",
        "GET /v1/models/{model}/learning",
        "PUT /v1/models/{model}/learning",
        "POST /v1/models/{model}/learning/change",
        "GET /v1/models/{model}/alarms",
        "GET /v1/models/{model}/live",
        "GET /metrics",
        "POST /v1/echo",
        "GET /v2",
        "GET /v2/health/live",
        "GET /v2/health/ready",
        "GET /v2/models/{model}",
        "GET /v2/models/{model}/ready",
        "GET /v2/models/{model}/versions/{version}",
        "GET /v2/models/{model}/versions/{version}/ready",
        *INFER,
    }


def test_every_reference_leads_somewhere(document):
    found = set(references(document))
    assert len(found) > 10
    for reference in found:
        assert resolve(document, reference)


def test_every_schema_is_used(document):
    used = {reference.rpartition("/")[2] for reference in references(document)}
    assert set(document["components"]["schemas"]) == used


def test_structure(document, operations):
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


def test_every_route_says_what_it_does(operations):
    for name, operation in operations.items():
        assert operation["tags"], name
        assert operation["summary"], name
        assert operation["description"], name
        assert operation["description"] != operation["summary"], name


def test_every_parameter_has_a_type_and_a_description(operations):
    for name, operation in operations.items():
        for item in operation.get("parameters", []):
            assert "schema" in item, (name, item["name"])
            assert item["in"] == "path" or item["description"], (name, item["name"])


def test_every_documented_error_has_the_one_shape(operations):
    for name, operation in operations.items():
        errors = {status: response for status, response in operation["responses"].items() if int(status) >= 400}
        of_v2 = " /v2" in name
        for status, response in errors.items():
            schema = FAILURE if of_v2 else ERROR
            assert response["content"] == {"application/json": {"schema": schema}}, (name, status)
            assert of_v2 or response["description"].startswith("`"), (name, status)


@pytest.mark.parametrize(
    ("operation", "statuses"),
    [
        ("GET /health/ready", {503}),
        ("POST /v1/datasets", {413, 415, 422}),
        ("GET /v1/datasets", {422}),
        ("GET /v1/datasets/{dataset}", {404}),
        ("GET /v1/datasets/{dataset}/preview", {404, 500}),
        ("DELETE /v1/datasets/{dataset}", {404, 409}),
        ("POST /v1/robots", {413, 415, 422}),
        ("GET /v1/robots/{robot}", {404}),
        ("DELETE /v1/robots/{robot}", {404, 409}),
        ("POST /v1/jobs", {404, 413, 422, 429}),
        ("GET /v1/jobs/{job}", {404}),
        ("POST /v1/jobs/{job}/cancel", {404, 409}),
        ("POST /v1/jobs/{job}/retry", {404, 409, 429}),
        ("GET /v1/jobs/{job}/events", {404}),
        ("GET /v1/models/{model}", {404}),
        ("GET /v1/models/{model}/versions/{version}", {404, 422}),
        ("DELETE /v1/models/{model}", {404, 409}),
        ("DELETE /v1/models/{model}/versions/{version}", {404, 409, 422}),
        ("PUT /v1/models/{model}/aliases/{alias}", {404, 409, 413, 422, 500}),
        ("DELETE /v1/models/{model}/aliases/{alias}", {404, 409, 422}),
        ("POST /v1/models/{model}/aliases/{alias}/rollback", {404, 409, 422, 500}),
        ("POST /v1/models/{model}/compare", {404, 413, 422, 500}),
        ("GET /v1/models/{model}/export", {404, 422, 500}),
        ("GET /v1/models/{model}/urdf", {404, 422}),
        ("POST /v1/models/import", {413, 415, 422}),
        ("POST /v1/models/{model}/predict", {404, 413, 422}),
        ("POST /v1/models/{model}/evaluate", {404, 413, 422}),
        ("POST /v1/models/{model}/trace", {404, 413, 422, 500}),
        ("POST /v1/models/{model}/observations", {404, 409, 413, 422, 429}),
        ("GET /v1/models/{model}/observations", {404, 422}),
        ("GET /v1/models/{model}/observations/{stream_id}/{sequence}", {404, 422}),
        ("DELETE /v1/models/{model}/observations/{stream_id}/{sequence}", {404, 409, 422}),
        ("POST /v1/models/{model}/observations/{stream_id}/{sequence}/replay", {404, 409, 413, 422}),
        ("POST /v1/models/{model}/rollback", {404, 409, 413, 422, 500}),
        ("POST /v1/models/{model}/refresh", {404, 409, 413, 422, 429}),
        ("GET /v1/models/{model}/quality", {404}),
        ("GET /v1/models/{model}/learning", {404}),
        ("PUT /v1/models/{model}/learning", {404, 413, 422}),
        ("POST /v1/models/{model}/learning/change", {404, 409, 413, 422}),
        ("GET /v1/models/{model}/alarms", {404, 422}),
        ("POST /v1/echo", {413}),
        ("GET /v2/health/ready", {503}),
        ("GET /v2/models/{model}", {404}),
        ("GET /v2/models/{model}/versions/{version}/ready", {404, 503}),
        (INFER[0], {400, 404, 413, 415}),
        (INFER[1], {400, 404, 413, 415}),
    ],
)
def test_errors_that_a_route_answers_are_documented(operations, operation, statuses):
    assert {str(status) for status in statuses} <= set(operations[operation]["responses"])


def test_errors_that_any_route_answers_are_documented_at_each(operations):
    for name, operation in operations.items():
        answered = set(operation["responses"])
        wrong = "400" if " /v2" in name else "422"
        assert {wrong, "403", "429", "500", "503"} <= answered, name
        assert ("401" in answered) != name.endswith(("/health/live", "/health/ready")), name
        assert ("requestBody" in operation) == ("408" in answered) == ("413" in answered) == ("415" in answered), name
        stores = not name.startswith("GET") and not name.endswith(
            ("/predict", "/evaluate", "/trace", "/compare", "/echo", "/infer")
        )
        assert ("507" in answered) == stores, name


def test_error_codes_are_in_the_description(document):
    description = document["info"]["description"]
    for code in ("not_found", "method_not_allowed", "expired", "learning_disabled", "storage_full", "internal_error"):
        assert f"`{code}`" in description


def test_requests_have_examples(document, operations):
    bodies = {name: operation["requestBody"] for name, operation in operations.items() if "requestBody" in operation}
    assert set(bodies) == {
        "POST /v1/datasets",
        "POST /v1/robots",
        "POST /v1/jobs",
        "POST /v1/models/import",
        "PUT /v1/models/{model}/aliases/{alias}",
        "POST /v1/models/{model}/compare",
        "POST /v1/models/{model}/predict",
        "POST /v1/models/{model}/evaluate",
        "POST /v1/models/{model}/trace",
        "POST /v1/models/{model}/observations",
        "POST /v1/models/{model}/observations/{stream_id}/{sequence}/replay",
        "POST /v1/models/{model}/rollback",
        "POST /v1/models/{model}/refresh",
        "PUT /v1/models/{model}/learning",
        "POST /v1/models/{model}/learning/change",
        "POST /v1/echo",
        *INFER,
    }
    for name, body in bodies.items():
        assert body["required"] is True
        media = next(iter(body["content"].values()))
        schema = media["schema"]
        schema = resolve(document, schema["$ref"]) if "$ref" in schema else schema
        binary = schema.get("format") == "binary"  # an archive, which no page can show
        assert media.get("example") or schema.get("examples") or binary, name


def test_the_example_of_a_query_is_answered(api, document):
    (example,) = document["components"]["schemas"]["PredictRequest"]["examples"]
    assert api.post("/v1/models/panda-sim/predict", json=example).status_code == 200


@pytest.mark.parametrize("operation", INFER)
def test_the_example_of_an_inference_is_answered_as_documented(api, operations, operation):
    documented = operations[operation]
    answered = documented["responses"]["200"]["content"]
    assert (
        set(documented["requestBody"]["content"]) == set(answered) == {"application/json", "application/octet-stream"}
    )
    path = operation.removeprefix("POST ").format(model="panda-sim", version=1)
    answer = api.post(path, json=documented["requestBody"]["content"]["application/json"]["example"])
    assert answer.status_code == 200, answer.text
    found, expected = answer.json(), answered["application/json"]["example"]
    numbers, shown = ([each.pop("data") for each in body["outputs"]] for body in (found, expected))
    assert found == expected
    assert np.allclose(numbers, shown, atol=0.1)


def test_media_types_of_an_upload(operations):
    content = operations["POST /v1/datasets"]["requestBody"]["content"]
    assert set(content) == {*MEDIA_TYPES, "multipart/form-data"}


def test_the_document_is_plain_json(document):
    assert json.loads(json.dumps(document, allow_nan=False)) == document


def test_the_documentation_is_served(api):
    answer = api.get("/docs")
    assert answer.status_code == 200
    assert "openapi.json" in answer.text


def test_the_documentation_page_loads_nothing_from_other_hosts(api):
    page = api.get("/docs").text
    assert "https://" not in page
    assert "http://" not in page
    assets = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert len(assets) >= 2
    for asset in assets:
        assert api.get(asset).status_code == 200

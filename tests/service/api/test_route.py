"""What all routes have in common: their class, its JSON parser, and the errors that it raises."""

import json
from unittest.mock import AsyncMock

import pytest
from fastapi.routing import APIRoute, iter_route_contexts
from hypothesis import given
from hypothesis import strategies as st

from service.api.route import Route
from service.foundation.errors import InvalidRequestError, problem, readable
from service.foundation.fields import first_repeat
from service.foundation.json_text import has_unique_fields, read_json
from tests import ROOT
from tests.service.data import error, service_of

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda below: st.lists(below, max_size=4) | st.dictionaries(st.text(), below, max_size=4),
    max_leaves=12,
)
PLOTLY = {f"/dashboard/plotly/{name}.js" for name in ("cartesian", "gl3d", "{digest}")}
PAGES = PLOTLY | {"/", "/docs", "/docs/oauth2-redirect", "/guide"}
"""Pages for people, which take no parameters."""


def test_every_route_has_the_checking_class(api):
    routes = [result.original_route for result in iter_route_contexts(api.app.routes)]
    unchecked = {route.path for route in routes if isinstance(route, APIRoute) and not isinstance(route, Route)}
    assert unchecked == PAGES
    assert sum(isinstance(route, Route) for route in routes) > 40


@given(VALUES)
def test_json_is_parsed_as_python_parses_it(value):
    assert read_json(json.dumps(value).encode()) == value
    text = json.dumps(value, ensure_ascii=False).encode(errors="surrogatepass")
    try:
        text.decode()
    except UnicodeDecodeError:
        with pytest.raises(InvalidRequestError, match="not UTF-8"):
            read_json(text)
    else:
        assert read_json(text) == value


@given(st.dictionaries(st.text(), VALUES, min_size=1, max_size=4), st.data())
def test_duplicate_field_is_named(value, data):
    name = data.draw(st.sampled_from(sorted(value)))
    members = [*value.items(), (name, data.draw(VALUES))]
    text = "{" + ", ".join(f"{json.dumps(key)}: {json.dumps(item)}" for key, item in members) + "}"
    for wrong in (text, f"[{text}]", f'{{"options": {text}}}'):
        with pytest.raises(InvalidRequestError) as raised:
            read_json(wrong.encode())
        assert raised.value.detail == [problem(name, "given twice", "each field once")]


def test_duplicates_are_found_in_linear_time():
    class Name(str):
        compared = 0
        __hash__ = str.__hash__

        def __eq__(self, other):
            Name.compared += 1
            return super().__eq__(other)

    names = [Name(f"field {number}") for number in range(2000)]
    assert first_repeat(names) is None
    assert first_repeat([*names, Name("field 1000"), Name("field 1")]) == 2000
    assert Name.compared < 100  # a comparison with each of the others would need four million


def test_fields_are_counted_once():
    assert has_unique_fields(b'{"q": [0], "dq": [0]}')
    assert has_unique_fields(b'{"q": [0], "more": {"q": [0], "{": {"q": {}}}, "dq": [0]}')
    assert not has_unique_fields(b'{"q": [0], "more": {"q": [0], "dq": {"dq": 1}, "q": 2}}')
    assert not has_unique_fields(b'{"q": [0], "more": {"dq": {"q": {}}}, "q": 2}')
    assert not has_unique_fields(b'["q", "q"]')
    for repeated in (b'"dq": [0], "q": 0', b'"\\u0071": [0]', b'"alias": "q"'):  # the last is ambiguous
        assert not has_unique_fields(b'{"q": [0], ' + repeated + b"}")


@given(st.text())
def test_shown_values_are_printable_and_distinct(text):
    view = readable(text)
    assert view.isprintable()
    assert view.encode().decode() == view
    if text.isprintable():
        assert view == text


def test_large_or_deep_values_are_shortened():
    deep = []
    for _ in range(5000):
        deep = [deep]
    for value in (deep, [deep] * 3, ["x" * 10**6] * 1000, {"a": deep}, list(range(10**6))):
        assert len(problem("q", value, "a number").value) <= 201


def test_many_wrong_fields_give_a_short_answer(api):
    body = {"model": "a", "datasets": list(range(900)), "x" * 9000: 1}
    problems = error(api.post("/v1/jobs", json=body), 422, "invalid_request")["detail"]
    assert len(problems) == 20
    assert max(len(each["field"]) for each in problems) < 500


def test_deeply_nested_json_is_rejected(api):
    body = b'{"q": ' + b"[" * 50_000 + b"]" * 50_000 + b"}"
    for path in ("predict", "observations", "evaluate"):
        answer = api.post(f"/v1/models/panda-sim/{path}", content=body, headers={"content-type": "application/json"})
        assert "nested too deep" in error(answer, 422, "invalid_request")["message"]


def test_oversized_objects_and_lists_are_rejected_unread(api):
    fields = error(api.post("/v1/jobs", json=dict.fromkeys(map(str, range(5000)), 0)), 422, "invalid_request")
    assert fields["detail"] == [{"field": "body", "value": "an object of 5000 fields", "expected": "at most 1000"}]
    lists = {
        "/v1/jobs": {"model": "a", "datasets": [0] * 5000},
        "/v1/jobs/check": {"model": "a", "joint_types": [0] * 5000},
        "/v1/models/panda-sim/predict": {"q": [0] * 7, "dq": [0] * 7, "ddq": [0] * 7, "components": [0] * 5000},
        "/v1/models/panda-sim/trace": {"dataset": "ds_0", "components": [0] * 5000},
    }
    for path, body in lists.items():
        problems = error(api.post(path, json=body), 422, "invalid_request")["detail"]
        assert [each["field"] for each in problems if each["field"].endswith("]")] == []
        assert any("at most" in each["expected"] for each in problems)
    answer = api.put("/v1/models/panda-sim/learning", json={"torque_limits": [None] * 5000})
    assert [each["field"] for each in error(answer, 422, "invalid_request")["detail"]] == ["torque_limits"]


def test_page_of_error_codes_equals_the_openapi_document(api):
    page = (ROOT / "docs/errors.md").read_text()
    description = api.get("/openapi.json").json()["info"]["description"]
    table = page[page.index("| status |") :]
    assert table in description, "run: python docs/errors.py"
    assert len(table.splitlines()) > 20


@pytest.mark.parametrize(("path", "kind"), [("/v1/jobs", b"application/json"), ("/v1/datasets", b"text/csv")])
def test_disconnected_client_is_no_failure(api, caplog, path, kind):
    arriving = [{"type": "http.request", "body": b"{", "more_body": True}, {"type": "http.disconnect"}]
    send, receive = AsyncMock(), AsyncMock(side_effect=arriving)
    headers = [(b"host", b"localhost"), (b"content-type", kind)]
    scope = {"type": "http", "method": "POST", "path": path, "headers": headers, "query_string": b""}
    api.portal.call(api.app, scope | {"root_path": "", "client": None}, receive, send)
    assert send.await_args_list[0].args[0]["status"] == 422
    assert "unexpected error" not in caplog.text
    assert list(service_of(api).files.uploads.iterdir()) == []

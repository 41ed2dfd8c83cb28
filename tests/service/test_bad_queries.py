"""Torque queries that are refused, with the place of what is wrong."""

from __future__ import annotations

import json

import pytest

from tests.service.data import error

ZERO = [0.0] * 7
PANDA = "panda_joint1, panda_joint2, panda_joint3, panda_joint4, panda_joint5, panda_joint6, panda_joint7"


def ask(api, model="panda-sim", **changes):
    return api.post(f"/v1/models/{model}/predict", json={"q": ZERO, "dq": ZERO, "ddq": ZERO} | changes)


def ask_raw(api, q):
    """A query whose `q` is JSON text, so that it may be what no JSON library writes."""
    body = f'{{"q": {q}, "dq": {json.dumps(ZERO)}, "ddq": {json.dumps(ZERO)}}}'
    return api.post("/v1/models/panda-sim/predict", content=body, headers={"content-type": "application/json"})


def with_first(text):
    return f"[{text}, 0, 0, 0, 0, 0, 0]"


@pytest.mark.parametrize(
    ("q", "field", "value"),
    [
        pytest.param(with_first("NaN"), "q[0]", "nan", id="NaN"),
        pytest.param(with_first("Infinity"), "q[0]", "inf", id="Infinity"),
        pytest.param(with_first("-Infinity"), "q[0]", "-inf", id="minus Infinity"),
        pytest.param(with_first("1e400"), "q[0]", "inf", id="overflow"),
        pytest.param(with_first("1" + "0" * 400), "q[0]", "1" + "0" * 199 + "…", id="huge whole number"),
        pytest.param(with_first('"1.0"'), "q[0]", "1.0", id="text"),
        pytest.param(with_first('"\\ud800"'), "q[0]", "\\ud800", id="half a character"),
        pytest.param(with_first("true"), "q[0]", "True", id="boolean"),
        pytest.param(with_first("null"), "q[0]", "None", id="null"),
        pytest.param(with_first("{}"), "q[0]", "{}", id="object"),
        pytest.param(with_first("[0]"), "q[1]", "0", id="list and numbers"),
        pytest.param("[0, 0, 0, [0], 0, 0, 0]", "q[3]", "[0]", id="numbers and a list"),
        pytest.param("[]", "q", "[]", id="empty"),
        pytest.param("[[]]", "q", "0 numbers long", id="empty row"),
        pytest.param("null", "q", "None", id="q null"),
        pytest.param('"0,0,0,0,0,0,0"', "q", "0,0,0,0,0,0,0", id="q text"),
        pytest.param("0", "q", "0", id="q number"),
        pytest.param("[[0, 0, 0, 0, 0, 0, 0], [0, 0]]", "q[1]", "[0, 0]", id="ragged"),
        pytest.param("[[0, 0, 0, 0, 0, 0, 0], 0]", "q[1]", "0", id="row and number"),
        pytest.param("[[0, 0, 0, 0, 0, 0, NaN]]", "q[0][6]", "nan", id="NaN in a row"),
        pytest.param("[[[0, 0, 0, 0, 0, 0, 0]]]", "q[0][0]", "[0, 0, 0, 0, 0, 0, 0]", id="nested too deep"),
    ],
)
def test_values_that_are_no_motion(strict, q, field, value):
    said = error(ask_raw(strict, q), 422, "invalid_request")
    assert said["detail"][0]["field"] == field
    assert said["detail"][0]["value"] == value


@pytest.mark.parametrize(
    "body",
    [
        pytest.param(b"", id="nothing"),
        pytest.param(b"{", id="cut off"),
        pytest.param(b"q=0", id="a form"),
        pytest.param(b"[]", id="a list"),
        pytest.param(b'"text"', id="a text"),
        pytest.param(b"null", id="null"),
        pytest.param(b'{"q": 01}', id="leading zero"),
    ],
)
def test_bodies_that_are_no_query(strict, body):
    answer = strict.post("/v1/models/panda-sim/predict", content=body, headers={"content-type": "application/json"})
    assert error(answer, 422, "invalid_request")["detail"][0]["field"] == "body"


@pytest.mark.parametrize("body", [b'{"q": "\xff"}', b"[" * 15_000, b'{"q": ' + b"9" * 5000 + b"}"])
def test_bodies_that_cannot_be_parsed(strict, body):
    answer = strict.post("/v1/models/panda-sim/predict", content=body, headers={"content-type": "application/json"})
    error(answer, 422, "invalid_request")


@pytest.mark.parametrize("media_type", ["text/plain", "application/x-www-form-urlencoded"])
def test_json_has_to_be_announced(strict, media_type):
    answer = strict.post("/v1/models/panda-sim/predict", content=b"{}", headers={"content-type": media_type})
    assert "application/json" in error(answer, 415, "unsupported_media_type")["message"]


@pytest.mark.parametrize("width", [1, 6, 8])
def test_a_wrong_number_of_joints_lists_the_joints(strict, width):
    wrong = [0.0] * width
    for changes in ({"q": wrong, "dq": wrong, "ddq": wrong}, {"q": [wrong], "dq": [wrong], "ddq": [wrong]}):
        said = error(ask(strict, **changes), 422, "invalid_request")
        assert said["detail"] == [
            {"field": "q", "value": f"{width} numbers long", "expected": f"7 numbers: {PANDA}"},
        ]


@pytest.mark.parametrize("name", ["dq", "ddq"])
@pytest.mark.parametrize("values", [ZERO[:6], [ZERO], [ZERO, ZERO]])
def test_velocities_and_accelerations_are_shaped_as_positions(strict, name, values):
    said = error(ask(strict, **{name: values}), 422, "invalid_request")
    assert said["detail"][0]["field"] == name


@pytest.mark.parametrize("name", ["q", "dq", "ddq"])
def test_nothing_may_be_left_out(strict, name):
    body = {kind: ZERO for kind in ("q", "dq", "ddq") if kind != name}
    said = error(strict.post("/v1/models/panda-sim/predict", json=body), 422, "invalid_request")
    assert said["detail"] == [{"field": name, "value": "missing", "expected": "a value"}]


def test_unknown_fields_are_named(strict):
    said = error(ask(strict, qdd=ZERO), 422, "invalid_request")
    assert (said["detail"][0]["field"], said["detail"][0]["expected"]) == ("qdd", "no field of that name")


def test_a_batch_has_a_limit(strict):
    assert ask(strict, q=[ZERO] * 20, dq=[ZERO] * 20, ddq=[ZERO] * 20).status_code == 200
    said = error(ask(strict, q=[ZERO] * 21, dq=[ZERO] * 21, ddq=[ZERO] * 21), 422, "invalid_request")
    assert said["detail"] == [{"field": "q", "value": "21 queries", "expected": "at most 20 in one request"}]


def test_degrees_are_recognised(strict):
    degrees = [0.0, -30.0, 0.0, -115.0, 0.0, 85.0, 40.0]
    said = error(ask(strict, q=degrees), 422, "invalid_request")
    assert said["detail"][0]["field"] == "q[3]"
    assert "are these degrees?" in said["message"]
    batch = {"q": [ZERO, degrees], "dq": [ZERO] * 2, "ddq": [ZERO] * 2}
    assert error(ask(strict, **batch), 422, "invalid_request")["detail"][0]["field"] == "q[1][3]"


def test_large_velocities_and_accelerations_are_answered_unclipped(strict):
    """Twice the speed is four times the centrifugal torque: nothing between is cut."""
    answers = [ask(strict, dq=[speed, *ZERO[1:]]).json() for speed in (1e3, 2e3)]
    assert all(max(map(abs, answer["tau"])) > 1e3 for answer in answers)


@pytest.mark.parametrize("model", ["nobody", "panda", "PANDA-SIM", "%2e%2e", "panda-sim%00", "%ff"])
def test_unknown_models_are_not_found(strict, model):
    error(ask(strict, model), 404, "not_found")
    error(strict.get(f"/v1/models/{model}"), 404, "not_found")


def test_unknown_versions_are_not_found(strict):
    assert "2" in error(ask(strict, version=2), 404, "not_found")["message"]
    error(strict.get("/v1/models/panda-sim/versions/2"), 404, "not_found")
    error(strict.get("/v1/models/nobody/versions/1"), 404, "not_found")


@pytest.mark.parametrize("version", ["x", "0", "-1", "1.5", "9" * 30, "1e400", "%00"])
def test_versions_that_are_no_numbers_are_refused(strict, version):
    said = error(strict.get(f"/v1/models/panda-sim/versions/{version}"), 422, "invalid_request")
    assert said["detail"][0]["field"] == "version"


@pytest.mark.parametrize("version", [0, -1, 1.5, "x", 10**30, []])
def test_versions_of_queries_are_numbers(strict, version):
    said = error(ask(strict, version=version), 422, "invalid_request")
    assert said["detail"][0]["field"] == "version"


@pytest.mark.parametrize("body", [lambda: b"[" + b" " * 20_000, lambda: (b" " * 1000 for _ in range(21))])
@pytest.mark.parametrize("path", ["/v1/models/panda-sim/predict", "/v1/models/panda-sim/evaluate", "/v1/jobs"])
def test_bodies_beyond_the_limit_are_refused(strict, path, body):
    answer = strict.post(path, content=body(), headers={"content-type": "application/json"})
    assert "20000 bytes" in error(answer, 413, "too_large")["message"]

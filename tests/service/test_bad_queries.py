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


@pytest.mark.parametrize("width", [1, 6, 8])
def test_a_wrong_number_of_joints_lists_the_joints(strict, width):
    wrong = [0.0] * width
    for changes in ({"q": wrong, "dq": wrong, "ddq": wrong}, {"q": [wrong], "dq": [wrong], "ddq": [wrong]}):
        said = error(ask(strict, **changes), 422, "invalid_request")
        assert said["detail"] == [
            {"field": "q", "value": f"{width} numbers long", "expected": f"7 numbers: {PANDA}"},
        ]


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


def test_unknown_versions_are_not_found(strict):
    assert "2" in error(ask(strict, version=2), 404, "not_found")["message"]
    error(strict.get("/v1/models/panda-sim/versions/2"), 404, "not_found")
    error(strict.get("/v1/models/nobody/versions/1"), 404, "not_found")


@pytest.mark.parametrize("body", [lambda: b"[" + b" " * 20_000, lambda: (b" " * 1000 for _ in range(21))])
@pytest.mark.parametrize("path", ["/v1/models/panda-sim/predict", "/v1/models/panda-sim/evaluate", "/v1/jobs"])
def test_bodies_beyond_the_limit_are_refused(strict, path, body):
    answer = strict.post(path, content=body(), headers={"content-type": "application/json"})
    assert "20000 bytes" in error(answer, 413, "too_large")["message"]

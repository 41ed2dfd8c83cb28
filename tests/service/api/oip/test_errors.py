"""Errors of the Open Inference Protocol: in its shape, with field, value and expected value."""

import json
from unittest.mock import Mock

import numpy as np
import pytest
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st

from lipcore.model import dynamics
from service.api.errors import UNEXPECTED_ERROR
from service.api.oip import query as answering
from tests.service.api.oip.requests import changed, error_message, infer_path, message, wrong_requests
from tests.service.data import ADDRESS

MOTION = {"q": [0.3, -0.7], "dq": [1.1, 0.2], "ddq": [-2.0, 0.9]}
PATH = infer_path("pendulum")


def rejection(api, request, status=400):
    return error_message(api.post(PATH, json=request), status)


WRONG = wrong_requests(MOTION, "joint1, joint2") | {
    "huger": (changed(MOTION, 0, shape=[10**30, 2]), f"q.shape is [{10**30}, 2], expected at most"),
    "too few": (
        changed(MOTION, 1, data=[1.0]),
        "`dq.data` has 1 numbers, expected 2 numbers, flat or in rows, for shape [2].",
    ),
    "row": (changed(MOTION, 1, data=[[0.0, 0.0]]), "`dq.data` has rows of shape [1, 2], expected 2 numbers"),
    "mixed": (changed(MOTION, 1, data=[0.0, [0.0]]), "`dq.data` has numbers and lists, or lists of"),
    "no data": (changed(MOTION, 1, data=None), "Input `dq` has neither `data` nor `binary_data_size`."),
    "data twice": (changed(MOTION, 1, parameters={"binary_data_size": 0}), "Input `dq` has both `data` and `binary_"),
    "other model": (message(MOTION, model_name="x"), "model_name is x, expected pendulum, as in the path"),
    "other version": (message(MOTION, model_version="2"), "model_version is 2, expected 1, as in the path"),
    "FP32": (changed(MOTION, 2, datatype="FP32", data=[1e39, 0.0]), "ddq[0] is inf, expected a finite number of FP32"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_wrong_requests_are_rejected(api, trained, kind):
    request, message = WRONG[kind]
    assert rejection(api, request).startswith(message)


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("q", "NaN", "inputs[0].data[1] is nan, expected a finite number"),
        ("q", "1" + "0" * 400, "inputs[0].data[1] is 1" + "0" * 199 + "…, expected a finite number"),
        ("q", "9" * 5000, "inputs[0].data[1] is out of range, expected a finite number"),
        ("q", '"1.0"', "inputs[0].data[1] is 1.0, expected a number, or a list of numbers"),
        ("q", "true", "inputs[0].data[1] is True, expected a number, or a list of numbers"),
        ("q", "[[0]]", "inputs[0].data[1][0] is [0], expected a number"),
        ("shape", "2.0", "inputs[0].shape[0] is 2.0, expected a whole number"),
        ("shape", "-2", "inputs[0].shape[0] is -2, expected a whole number of at least 0"),
        ("size", "-16", "inputs[0].parameters.binary_data_size is -16, expected a whole number of at least 0"),
    ],
)
def test_values_of_wrong_types_are_named(api, trained, place, value, message):
    values = {"q": "-0.7", "shape": "2", "size": "null"} | {place: value}
    tensor = (
        f'{{"name": "q", "datatype": "FP64", "shape": [{values["shape"]}], "data": [0, {values["q"]}], '
        f'"parameters": {{"binary_data_size": {values["size"]}}}}}'
    )
    assert error_message(api.post(PATH, content=f'{{"inputs": [{tensor}]}}')) == message


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (b"", "The body is not JSON: Input data was truncated. If binary tensors follow the JSON, "),
        (b'{"inputs": []} {}', "The body is not JSON: trailing characters (byte "),
        (b"\xef\xbb\xbf{}", "The body is not JSON: invalid character (byte 0). If"),
        (b'{"id": "\xff"}', "The body is not JSON: 'utf-8' codec can't decode byte 0xff"),
        (b'{"parameters": {"x": ' + b"[" * 15_000, "The body is not JSON: maximum recursion depth exceeded"),
        (b"[" * 15_000, "the body is array, expected an object"),
        (b"{}", "`inputs` is required."),
        (b'{"inputs": [{"name": "q", "shape": [2]}]}', "`inputs[0].datatype` is required."),
        (b'{"inputs": [], "output": []}', "Unknown field `output`."),
        (b'{"inputs": [], "outputs": ["tau"]}', "outputs[0] is tau, expected an object"),
        (b'{"inputs": [], "id": 42}', "id is 42, expected a string"),
        (b'{"inputs": [], "parameters": {"binary_data_output": 1}}', "parameters.binary_data_output is 1, expected tr"),
        (b'{"inputs": [{"name": 5}], "inputs": []}', "inputs[0].name is int, expected a string"),
    ],
)
def test_bodies_that_are_no_request_are_rejected(api, trained, body, message):
    assert error_message(api.post(PATH, content=body)).startswith(message)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["name", "data", "x"]), inner),
    max_leaves=6,
)


@given(data=st.data())
def test_any_json_is_answered_or_rejected(api, trained, data):
    """JSON as Python writes it, with NaN."""
    request = message(MOTION, "tau")
    place = data.draw(st.sampled_from([request, request["inputs"][0], request["outputs"][0]]))
    place[data.draw(st.sampled_from([*place, "parameters", "id"]))] = data.draw(JSON)
    answer = api.post(PATH, content=json.dumps(request).encode())
    if answer.status_code != 200:
        error_message(answer)


def test_singular_inertia_error_names_the_query(api, trained, monkeypatch):
    singular = np.tile(np.eye(2), (3, 1, 1))
    singular[1, 1, 1] = -0.1
    monkeypatch.setattr(dynamics, "inertia_matrix", lambda *_: singular)
    batch = {name: np.tile(values, (3, 1)) for name, values in (MOTION | {"tau": [0.0, 0.0]}).items()}
    reply = rejection(api, message(batch, "forward_dynamics"))
    assert reply.startswith(
        "q[1] is a posture in which the learnt inertia matrix is not positive definite, expected for"
    )


@pytest.mark.parametrize("rows", [1, 2])
def test_non_finite_answers_are_rejected(api, trained, monkeypatch, rows):
    monkeypatch.setattr(answering, "compute", lambda *_: {"tau": np.full((rows, 2), np.inf)})
    batch = {name: np.tile(values, (rows, 1)) for name, values in MOTION.items()}
    reply = rejection(api, message(batch, "tau"))
    assert reply == "tau[0][0] is inf, expected a finite number: are dq in rad/s and ddq in rad/s²?"


@pytest.mark.parametrize("body", [lambda: b" " * 20_001, lambda: (b" " * 1000 for _ in range(21))])
def test_bodies_beyond_the_limit_are_rejected(strict, body):
    reply = error_message(strict.post(infer_path("panda-sim"), content=body()), 413)
    assert reply == "The body is too large: at most 20000 bytes are allowed."


def test_compressed_bodies_are_rejected(api, trained):
    answer = api.post(PATH, json=message(MOTION), headers={"content-encoding": "deflate"})
    assert error_message(answer, 415) == "Content-Encoding is deflate, expected an uncompressed body"
    assert api.post(PATH, json=message(MOTION), headers={"content-encoding": "identity"}).status_code == 200


def test_unexpected_errors_reveal_no_internals(api, trained, monkeypatch):
    monkeypatch.setattr(answering, "compute", Mock(side_effect=RuntimeError("secret")))
    quiet = TestClient(api.app, ADDRESS, raise_server_exceptions=False)
    reply = error_message(quiet.post(PATH, json=message(MOTION)), 500)
    assert reply == UNEXPECTED_ERROR

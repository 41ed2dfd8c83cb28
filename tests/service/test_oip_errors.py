"""The Open Inference Protocol: what is refused, in its own shape, naming field, value and what is expected."""

import json

import numpy as np
import pytest
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st

from lipcore.model import dynamics
from service.api.oip import query as answering
from tests.service.data import ADDRESS
from tests.service.oip import message, path_of, refused

MOTION = {"q": [0.3, -0.7], "dq": [1.1, 0.2], "ddq": [-2.0, 0.9]}
PATH = path_of("pendulum")
JOINTS = "[2] for one query or [N, 2] for a batch: the joints are joint1, joint2"
OTHERS = "tensors in the body: of the extensions, binary_tensor_data is supported"


def changed(place, **changes):
    """A right request but for one input, of which None removes a member."""
    entire = message(MOTION)
    wrong = entire["inputs"][place] | changes
    entire["inputs"][place] = {key: value for key, value in wrong.items() if value is not None}
    return entire


def refusal(api, request, status=400):
    return refused(api.post(PATH, json=request), status)


def asking(name, **parameters):
    return message(MOTION) | {"outputs": [{"name": name, "parameters": parameters}]}


REGION = {"shared_memory_region": "r"}
WRONG = {
    "unknown input": (changed(0, name="p"), "inputs[0].name is p, expected one of q, dq, ddq"),
    "input twice": (changed(1, name="q"), "inputs[1].name is q, expected each input once"),
    "no inputs": ({"inputs": []}, "q is missing, expected the inputs q, dq, ddq"),
    "datatype": (changed(0, datatype="INT32"), "q.datatype is INT32, expected FP64 or FP32"),
    "joints": (changed(0, shape=[3]), f"q.shape is [3], expected {JOINTS}"),
    "no queries": (changed(0, shape=[0, 2]), f"q.shape is [0, 2], expected {JOINTS}"),
    "huge": (changed(0, shape=[10**30, 2]), f"q.shape is [{10**30}, 2], expected at most"),
    "other shape": (changed(1, shape=[1, 2]), "dq.shape is [1, 2], expected that of q, [2]"),
    "too few": (changed(1, data=[1.0]), "dq.data is 1 numbers, expected 2 numbers or rows of them, as the"),
    "row": (changed(1, data=[[0.0, 0.0]]), "dq.data is rows of shape [1, 2], expected 2 numbers"),
    "mixed": (changed(1, data=[0.0, [0.0]]), "dq.data is numbers and lists, or lists of"),
    "no data": (changed(1, data=None), "dq.data is missing, expected numbers in data, or binary_data_"),
    "data twice": (changed(1, parameters={"binary_data_size": 0}), "dq.data is given, and binary_data_size too, expe"),
    "shared memory": (
        changed(1, data=None, parameters=REGION),
        f"dq.parameters.shared_memory_region is r, expected {OTHERS}",
    ),
    "shared for an output": (asking("tau", **REGION), "outputs[0].parameters.shared_memory_region is r, ex"),
    "classification": (
        asking("tau", classification=3),
        f"outputs[0].parameters.classification is 3, expected {OTHERS}",
    ),
    "output": (message(MOTION, "tau", "torque"), "outputs[1].name is torque, expected what a"),
    "output twice": (message(MOTION, "tau", "tau"), "outputs[1].name is tau, expected each output once"),
    "no torque": (
        message(MOTION, "forward_dynamics_std"),
        "tau is missing, expected the torque that forward_dynamics or tau_external is asked for, shaped as q",
    ),
    "torque in vain": (
        message(MOTION | {"tau": [0.0, 0.0]}, "tau"),
        "tau is given, expected no tau, or forward_dynamics or tau_external among the outputs",
    ),
    "other model": (
        message(MOTION, model_name="x"),
        "model_name is x, expected that which the path leads to, pend",
    ),
    "other version": (
        message(MOTION, model_version="2"),
        "model_version is 2, expected that which the path leads to, 1",
    ),
    "degrees": (
        changed(0, data=[0.0, 90.0]),
        "q[1] is 90, expected radians (or metres) within ±12.6: are these degrees?",
    ),
    "FP32": (changed(2, datatype="FP32", data=[1e39, 0.0]), "ddq[0] is inf, expected a finite number of FP32"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_requests_that_are_refused(api, trained, kind):
    request, message = WRONG[kind]
    assert refusal(api, request).startswith(message)


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
    assert refused(api.post(PATH, content=f'{{"inputs": [{tensor}]}}')) == message


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (b"", "the body is not JSON: Input data was truncated, expected an inference request as JSON"),
        (b'{"inputs": []} {}', "the body is not JSON: trailing characters (byte "),
        (b"\xef\xbb\xbf{}", "the body is not JSON: invalid character (byte 0), expected"),
        (b'{"id": "\xff"}', "the body is not JSON: 'utf-8' codec can't decode byte 0xff"),
        (b'{"parameters": {"x": ' + b"[" * 15_000, "the body is not JSON: maximum recursion depth exceeded"),
        (b"[" * 15_000, "the body is array, expected an object"),
        (b"{}", "inputs is missing, expected a value"),
        (b'{"inputs": [{"name": "q", "shape": [2]}]}', "inputs[0].datatype is missing, expected a value"),
        (b'{"inputs": [], "output": []}', "output is given, expected no field of that name"),
        (b'{"inputs": [], "outputs": ["tau"]}', "outputs[0] is tau, expected an object"),
        (b'{"inputs": [], "id": 42}', "id is 42, expected a string"),
        (b'{"inputs": [], "parameters": {"binary_data_output": 1}}', "parameters.binary_data_output is 1, expected tr"),
        (b'{"inputs": [{"name": 5}], "inputs": []}', "inputs[0].name is int, expected a string"),
    ],
)
def test_bodies_that_are_no_request(api, trained, body, message):
    assert refused(api.post(PATH, content=body)).startswith(message)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["name", "data", "x"]), inner),
    max_leaves=6,
)


@given(data=st.data())
def test_json_of_any_kind_is_answered_or_refused(api, trained, data):
    """Python's JSON at that, which has NaN."""
    request = message(MOTION, "tau")
    place = data.draw(st.sampled_from([request, request["inputs"][0], request["outputs"][0]]))
    place[data.draw(st.sampled_from([*place, "parameters", "id"]))] = data.draw(JSON)
    answer = api.post(PATH, content=json.dumps(request).encode())
    if answer.status_code != 200:
        refused(answer)


def test_inertia_that_cannot_be_inverted_is_refused_naming_the_query(api, trained, monkeypatch):
    singular = np.tile(np.eye(2), (3, 1, 1))
    singular[1, 1, 1] = -0.1
    monkeypatch.setattr(dynamics, "inertia_matrix", lambda *_: singular)
    batch = {name: np.tile(values, (3, 1)) for name, values in (MOTION | {"tau": [0.0, 0.0]}).items()}
    reply = refusal(api, message(batch, "forward_dynamics"))
    assert reply.startswith("q[1] is a posture whose learnt inertia matrix is not positive definite, expected for")


@pytest.mark.parametrize("rows", [1, 2])
def test_answers_that_are_not_finite_are_refused(api, trained, monkeypatch, rows):
    def overflowing(model, query, names):
        return {name: np.full((rows, 2), np.inf) for name in names}

    monkeypatch.setattr(answering, "compute", overflowing)
    batch = {name: np.tile(values, (rows, 1)) for name, values in MOTION.items()}
    reply = refusal(api, message(batch, "tau"))
    assert reply == "tau[0][0] is inf, expected a finite number: are dq in rad/s and ddq in rad/s²?"


@pytest.mark.parametrize("body", [lambda: b" " * 20_001, lambda: (b" " * 1000 for _ in range(21))])
def test_bodies_beyond_the_limit(strict, body):
    reply = refused(strict.post(path_of("panda-sim"), content=body()), 413)
    assert reply == "the body has more than 20000 bytes, the most that is taken here"


def test_compressed_bodies_are_refused(api, trained):
    answer = api.post(PATH, json=message(MOTION), headers={"content-encoding": "deflate"})
    assert refused(answer, 415) == "Content-Encoding is deflate, expected none: bodies are taken uncompressed"
    assert api.post(PATH, json=message(MOTION), headers={"content-encoding": "identity"}).status_code == 200


def test_unexpected_errors_tell_nothing_of_the_inside(api, trained, monkeypatch):
    def broken(*_):
        raise RuntimeError("secret")

    monkeypatch.setattr(answering, "compute", broken)
    quiet = TestClient(api.app, ADDRESS, raise_server_exceptions=False)
    reply = refused(quiet.post(PATH, json=message(MOTION)), 500)
    assert reply == "an unexpected error; the service's log says more"

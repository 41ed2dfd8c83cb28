"""The Open Inference Protocol: what is refused, in its own shape, naming field, value and what is expected."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st

from lipcore.model import dynamics
from service.oip import answer as answering
from service.oip import query
from tests.service.data import ADDRESS, service_of
from tests.service.oip import listed, message, path_of, refused

MOTION = {"q": [0.3, -0.7], "dq": [1.1, 0.2], "ddq": [-2.0, 0.9]}
PATH = path_of("pendulum")
JOINTS = "[2] for one query or [N, 2] for a batch: the joints are joint1, joint2"
OTHERS = "tensors in the body: of the extensions, binary_tensor_data is supported"


def changed(place, **changes):
    """A right request but for one input, of which None removes a member."""
    whole = message(MOTION)
    wrong = whole["inputs"][place] | changes
    whole["inputs"][place] = {key: value for key, value in wrong.items() if value is not None}
    return whole


def rows(count, *names):
    """A batch of zeros."""
    return message({name: np.zeros((count, 2)) for name in ("q", "dq", "ddq")}, *names)


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
    "no axes": (changed(0, shape=[]), f"q.shape is [], expected {JOINTS}"),
    "no queries": (changed(0, shape=[0, 2]), f"q.shape is [0, 2], expected {JOINTS}"),
    "three axes": (changed(0, shape=[1, 1, 2]), f"q.shape is [1, 1, 2], expected {JOINTS}"),
    "huge": (changed(0, shape=[10**30, 2]), f"q.shape is [{10**30}, 2], expected at most"),
    "other shape": (changed(1, shape=[1, 2]), "dq.shape is [1, 2], expected that of q, [2]"),
    "too few": (changed(1, data=[1.0]), "dq.data is 1 numbers, expected 2 numbers or rows of them, as the"),
    "too many": (changed(1, data=[0.0] * 3), "dq.data is 3 numbers, expected 2 numbers or"),
    "row": (changed(1, data=[[0.0, 0.0]]), "dq.data is rows of shape [1, 2], expected 2 numbers"),
    "mixed": (changed(1, data=[0.0, [0.0]]), "dq.data is numbers and lists, or lists of"),
    "ragged": (changed(1, data=[[0.0], []]), "dq.data is numbers and lists, or lists of"),
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
        "tau is missing, expected the torque that forward_dynamics is asked for, shaped as q",
    ),
    "torque in vain": (
        message(MOTION | {"tau": [0.0, 0.0]}, "tau"),
        "tau is given, expected no tau, or forward_dynamics among the outputs",
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
        ("q", "1e400", "inputs[0].data[1] is inf, expected a finite number"),
        ("q", "1" + "0" * 400, "inputs[0].data[1] is 1" + "0" * 199 + "…, expected a finite number"),
        ("q", "9" * 5000, "inputs[0].data[1] is out of range, expected a finite number"),
        ("q", '"1.0"', "inputs[0].data[1] is 1.0, expected a number, or a list of numbers"),
        ("q", "true", "inputs[0].data[1] is True, expected a number, or a list of numbers"),
        ("q", "null", "inputs[0].data[1] is null, expected a number, or a list of numbers"),
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
        (b"q=0", "the body is not JSON: invalid character (byte 0), expected"),
        (b'{"inputs": []} {}', "the body is not JSON: trailing characters (byte "),
        (b"\xef\xbb\xbf{}", "the body is not JSON: invalid character (byte 0), expected"),
        (b'{"id": "\xff"}', "the body is not JSON: 'utf-8' codec can't decode byte 0xff"),
        (b'{"id": "\\ud800"}', "the body is not JSON: "),
        (b'{"parameters": {"x": ' + b"[" * 15_000, "the body is not JSON: maximum recursion depth exceeded"),
        (b'{"parameters": {"x": ' + b"[" * 900 + b"NaN", "the body is not JSON: "),
        (b"[" * 15_000, "the body is array, expected an object"),
        (b"[]", "the body is [], expected an object"),
        (b"{}", "inputs is missing, expected a value"),
        (b'{"inputs": {}}', "inputs is {}, expected a list"),
        (b'{"inputs": [{"name": "q", "shape": [2]}]}', "inputs[0].datatype is missing, expected a value"),
        (b'{"inputs": [], "output": []}', "output is given, expected no field of that name"),
        (b'{"inputs": [{"nam": 1}]}', "inputs[0].nam is given, expected no field of that name"),
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


def test_long_names_are_cut(api, trained):
    assert len(refusal(api, message(MOTION, "x" * 9000))) < 900
    assert len(refusal(api, message(MOTION) | {"x" * 9000: 1})) < 500


def test_unknown_outputs_are_answered_with_those_there_are(api, trained):
    said = refusal(api, message(MOTION, "mass"))
    for name in query.shapes(trained.model):
        assert name in said


def test_batches_have_limits(strict):
    zeros = {name: np.zeros((20, 7)) for name in ("q", "dq", "ddq")}
    assert strict.post(path_of("panda-sim"), json=message(zeros, "noise_std")).status_code == 200
    more = {name: np.zeros((21, 7)) for name in ("q", "dq", "ddq")}
    said = refused(strict.post(path_of("panda-sim"), json=message(more, "noise_std")))
    assert said == "q.shape is [21, 7], expected at most 20 queries in one request"


def test_batches_with_components_are_smaller(api, trained):
    assert service_of(api).settings.max_component_batch == 100
    said = refusal(api, rows(101, "tau", "tau_friction"))
    assert said == "q.shape is [101, 2], expected at most 100 queries in one request with components"
    assert api.post(PATH, json=rows(100, "tau_friction")).status_code == 200
    assert api.post(PATH, json=rows(101, "noise_std")).status_code == 200


def test_inertia_that_cannot_be_inverted_is_refused_naming_the_query(api, trained, monkeypatch):
    singular = torch.eye(2, dtype=torch.float64).repeat(3, 1, 1)
    singular[1, 1, 1] = -0.1
    monkeypatch.setattr(dynamics, "inertia_matrix", lambda *_: singular)
    batch = {name: np.tile(values, (3, 1)) for name, values in (MOTION | {"tau": [0.0, 0.0]}).items()}
    said = refusal(api, message(batch, "forward_dynamics"))
    assert said.startswith("q[1] is a posture whose learnt inertia matrix is not positive definite, expected for")


@pytest.mark.parametrize("rows", [1, 2])
def test_answers_that_are_not_finite_are_refused(api, trained, monkeypatch, rows):
    def overflowing(model, query, names):
        return {name: np.full((rows, 2), np.inf) for name in names}

    monkeypatch.setattr(answering, "compute", overflowing)
    batch = {name: np.tile(values, (rows, 1)) for name, values in MOTION.items()}
    said = refusal(api, message(batch, "tau"))
    assert said == "tau[0][0] is inf, expected a finite number: are dq in rad/s and ddq in rad/s²?"


def test_unknown_models_and_versions(api, trained):
    assert refused(api.post(path_of("nobody"), json=message(MOTION)), 404) == (
        "no model 'nobody': GET /v1/models lists all"
    )
    for version in ("2", "x"):
        said = refused(api.post(path_of("pendulum", version), json=message(MOTION)), 404)
        assert said == f"version is {version}, expected one of 1, of model 'pendulum'"


@pytest.mark.parametrize("path", ["/v2/models", "/v2/models/x/y", "/v2/repository/index"])
def test_unknown_routes(api, path):
    assert refused(api.get(path), 404) == f"no route GET {path}: /docs lists all"


@pytest.mark.parametrize(
    ("method", "path"), [("POST", "/v2"), ("DELETE", "/v2/models/pendulum"), ("GET", PATH), ("PUT", "/v2/health/live")]
)
def test_wrong_methods(api, method, path):
    answer = api.request(method, path)
    assert refused(answer, 405) == f"no route {method} {path}: /docs lists all"
    assert method not in answer.headers["allow"]


@pytest.mark.parametrize("body", [lambda: b" " * 20_001, lambda: (b" " * 1000 for _ in range(21))])
def test_bodies_beyond_the_limit(strict, body):
    said = refused(strict.post(path_of("panda-sim"), content=body()), 413)
    assert said == "the body has more than 20000 bytes, the most that is taken here"


def test_compressed_bodies_are_refused(api, trained):
    answer = api.post(PATH, json=message(MOTION), headers={"content-encoding": "deflate"})
    assert refused(answer, 415) == "Content-Encoding is deflate, expected none: bodies are taken uncompressed"
    assert api.post(PATH, json=message(MOTION), headers={"content-encoding": "identity"}).status_code == 200


def test_unexpected_errors_tell_nothing_of_the_inside(api, trained, monkeypatch):
    def broken(*_):
        raise RuntimeError("secret")

    monkeypatch.setattr(answering, "compute", broken)
    quiet = TestClient(api.app, ADDRESS, raise_server_exceptions=False)
    said = refused(quiet.post(PATH, json=message(MOTION)), 500)
    assert said == "an unexpected error; the service's log says more"


def test_a_client_that_goes_away_is_no_error(api, trained):
    arriving = iter([{"type": "http.request", "body": b"{", "more_body": True}, {"type": "http.disconnect"}])
    sent = []

    async def receive():
        return next(arriving)

    async def send(part):
        sent.append(part)

    scope = {"type": "http", "method": "POST", "path": PATH, "headers": [], "query_string": b"", "root_path": ""}
    api.portal.call(api.app, scope, receive, send)
    assert next(arriving, None) is None
    assert sent == []


def test_the_first_wrong_number_of_a_batch_is_named(api, trained):
    wrong = [[0.0, 0.0], [0.0, 20.0], [-30.0, 0.0]]
    batch = {"inputs": [listed(name, wrong if name == "q" else np.zeros((3, 2))) for name in MOTION]}
    assert refusal(api, batch).startswith("q[2][0] is -30, expected radians")

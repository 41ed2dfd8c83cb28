"""The Open Inference Protocol: what is refused, in its own shape, naming field, value and what is expected."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from fastapi.testclient import TestClient

from lipcore.model import dynamics
from service.oip import query
from service.oip import query as answering
from tests.service.data import ADDRESS, error, service_of
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


def say(api, request, status=400):
    return refused(api.post(PATH, json=request), status)


@pytest.mark.parametrize(
    ("request_", "said"),
    [
        pytest.param(changed(0, name="p"), "inputs[0].name is p, expected one of q, dq, ddq", id="unknown input"),
        pytest.param(changed(1, name="q"), "inputs[1].name is q, expected each input once", id="input twice"),
        pytest.param({"inputs": []}, "q is missing, expected the inputs q, dq, ddq", id="no inputs"),
        pytest.param(
            {"inputs": message(MOTION)["inputs"][:2]}, "ddq is missing, expected the inputs q, dq, ddq", id="no ddq"
        ),
        pytest.param(changed(0, datatype="INT32"), "q.datatype is INT32, expected FP64 or FP32", id="datatype"),
        pytest.param(changed(0, datatype="fp64"), "q.datatype is fp64, expected FP64 or FP32", id="small letters"),
        pytest.param(changed(0, shape=[3]), f"q.shape is [3], expected {JOINTS}", id="joints"),
        pytest.param(changed(0, shape=[]), f"q.shape is [], expected {JOINTS}", id="no axes"),
        pytest.param(changed(0, shape=[0, 2]), f"q.shape is [0, 2], expected {JOINTS}", id="no queries"),
        pytest.param(changed(0, shape=[1, 1, 2]), f"q.shape is [1, 1, 2], expected {JOINTS}", id="three axes"),
        pytest.param(changed(0, shape=[2, 1]), f"q.shape is [2, 1], expected {JOINTS}", id="turned"),
        pytest.param(changed(0, shape=[10**30, 2]), f"q.shape is [{10**30}, 2], expected at most", id="huge"),
        pytest.param(changed(1, shape=[1, 2]), "dq.shape is [1, 2], expected that of q, [2]", id="other shape"),
        pytest.param(
            changed(1, data=[1.0]), "dq.data is 1 numbers, expected 2 numbers or rows of them, as the", id="too few"
        ),
        pytest.param(changed(1, data=[0.0] * 3), "dq.data is 3 numbers, expected 2 numbers or", id="too many"),
        pytest.param(changed(1, data=[]), "dq.data is 0 numbers, expected 2 numbers or", id="none"),
        pytest.param(changed(1, data=[[0.0, 0.0]]), "dq.data is rows of shape [1, 2], expected 2 numbers", id="row"),
        pytest.param(changed(1, data=[0.0, [0.0]]), "dq.data is numbers and lists, or lists of", id="mixed"),
        pytest.param(changed(1, data=[[0.0], []]), "dq.data is numbers and lists, or lists of", id="ragged"),
        pytest.param(changed(1, data=None), "dq.data is missing, expected numbers in data, or binary_data_", id="data"),
        pytest.param(
            changed(1, parameters={"binary_data_size": 0}),
            "dq.data is given, and binary_data_size too, expected numbers in data, or",
            id="data twice",
        ),
        pytest.param(
            changed(1, data=None, parameters={"shared_memory_region": "r"}),
            f"dq.parameters.shared_memory_region is r, expected {OTHERS}",
            id="shared memory",
        ),
        pytest.param(
            message(MOTION) | {"outputs": [{"name": "tau", "parameters": {"classification": 3}}]},
            f"outputs[0].parameters.classification is 3, expected {OTHERS}",
            id="classification",
        ),
        pytest.param(
            message(MOTION) | {"outputs": [{"name": "tau", "parameters": {"shared_memory_region": "r"}}]},
            f"outputs[0].parameters.shared_memory_region is r, expected {OTHERS}",
            id="shared memory for an output",
        ),
        pytest.param(message(MOTION, "tau", "torque"), "outputs[1].name is torque, expected what a", id="output"),
        pytest.param(message(MOTION, "gravity"), "outputs[0].name is gravity, expected what a model with", id="bare"),
        pytest.param(message(MOTION, "tau", "tau"), "outputs[1].name is tau, expected each output once", id="twice"),
        pytest.param(
            message(MOTION, "forward_dynamics_std"),
            "tau is missing, expected the torque that forward_dynamics is asked for, shaped as q",
            id="no torque",
        ),
        pytest.param(
            message(MOTION | {"tau": [0.0, 0.0]}, "tau"),
            "tau is given, expected no tau, or forward_dynamics among the outputs",
            id="torque in vain",
        ),
        pytest.param(
            message(MOTION, model_name="panda-sim"),
            "model_name is panda-sim, expected that which the path leads to, pendulum",
            id="other model",
        ),
        pytest.param(
            message(MOTION, model_version="2"),
            "model_version is 2, expected that which the path leads to, 1",
            id="other version",
        ),
        pytest.param(
            changed(0, data=[0.0, 90.0]),
            "q[1] is 90, expected radians (or metres) within ±12.6: are these degrees?",
            id="degrees",
        ),
        pytest.param(
            changed(2, datatype="FP32", data=[1e39, 0.0]), "ddq[0] is inf, expected a finite number of FP32", id="FP32"
        ),
    ],
)
def test_requests_that_are_refused(api, trained, request_, said):
    assert say(api, request_).startswith(said)


def test_long_names_are_cut(api, trained):
    assert len(say(api, message(MOTION, "x" * 9000))) < 900
    assert len(say(api, message(MOTION) | {"x" * 9000: 1})) < 500


def test_unknown_outputs_are_answered_with_those_there_are(api, trained):
    said = say(api, message(MOTION, "mass"))
    for name in query.shapes(trained.model):
        assert name in said


def test_components_that_an_estimator_lacks_are_refused(api, trained, monkeypatch):
    monkeypatch.setattr("service.oip.query.available", lambda _: ("friction",))
    offered = "tau, tau_std, noise_std, covariance, tau_friction, tau_friction_std"
    assert say(api, message(MOTION, "tau_gravity")) == (
        f"outputs[0].name is tau_gravity, expected what a model with the estimator lip-chain offers: {offered}"
    )


def test_batches_have_limits(strict):
    zeros = {name: np.zeros((20, 7)) for name in ("q", "dq", "ddq")}
    assert strict.post(path_of("panda-sim"), json=message(zeros, "noise_std")).status_code == 200
    more = {name: np.zeros((21, 7)) for name in ("q", "dq", "ddq")}
    said = refused(strict.post(path_of("panda-sim"), json=message(more, "noise_std")))
    assert said == "q.shape is [21, 7], expected at most 20 queries in one request"


def test_batches_with_components_are_smaller(api, trained):
    assert service_of(api).settings.max_component_batch == 100
    said = say(api, rows(101, "tau", "tau_friction"))
    assert said == "q.shape is [101, 2], expected at most 100 queries in one request with components"
    assert api.post(PATH, json=rows(100, "tau_friction")).status_code == 200
    assert api.post(PATH, json=rows(101, "noise_std")).status_code == 200


def test_inertia_that_cannot_be_inverted_is_refused_naming_the_query(api, trained, monkeypatch):
    singular = torch.eye(2, dtype=torch.float64).repeat(3, 1, 1)
    singular[1, 1, 1] = -0.1
    monkeypatch.setattr(dynamics, "inertia_matrix", lambda *_: singular)
    batch = {name: np.tile(values, (3, 1)) for name, values in (MOTION | {"tau": [0.0, 0.0]}).items()}
    said = say(api, message(batch, "forward_dynamics"))
    assert said.startswith("q[1] is a posture whose learnt inertia matrix is not positive definite, expected for")


@pytest.mark.parametrize("rows", [1, 2])
def test_answers_that_are_not_finite_are_refused(api, trained, monkeypatch, rows):
    def overflowing(model, query, names):
        return {name: np.full((rows, 2), np.inf) for name in names}

    monkeypatch.setattr(answering, "compute", overflowing)
    batch = {name: np.tile(values, (rows, 1)) for name, values in MOTION.items()}
    said = say(api, message(batch, "tau"))
    assert said == "tau[0][0] is inf, expected a finite number: are dq in rad/s and ddq in rad/s²?"


@pytest.mark.parametrize("encoding", ["gzip", "deflate"])
def test_compressed_bodies_are_refused(api, trained, encoding):
    answer = api.post(PATH, json=message(MOTION), headers={"content-encoding": encoding})
    assert refused(answer, 415) == f"Content-Encoding is {encoding}, expected none: bodies are taken uncompressed"
    plain = api.post(PATH, json=message(MOTION), headers={"content-encoding": "identity"})
    assert plain.status_code == 200


def test_unknown_models_and_versions(api, trained):
    assert refused(api.post(path_of("nobody"), json=message(MOTION)), 404) == (
        "no model 'nobody': GET /v1/models lists all"
    )
    for version in ("2", "x", "0", "01"):
        said = refused(api.post(path_of("pendulum", version), json=message(MOTION)), 404)
        assert said == f"version is {version}, expected one of 1, of model 'pendulum'"


@pytest.mark.parametrize("path", ["/v2/models", "/v2/nowhere", "/v2/models/x/y", "/v2/health", "/v2/repository/index"])
def test_unknown_routes(api, path):
    assert refused(api.get(path), 404) == f"no route GET {path}: /docs lists all"


@pytest.mark.parametrize("path", ["/v2x", "/v22/models", "/v1/v2"])
def test_routes_elsewhere_keep_the_house_shape(api, path):
    error(api.get(path), 404, "not_found")


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
    error(strict.post("/v1/models/panda-sim/predict", content=body()), 413, "too_large")


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


def test_an_error_leaves_the_next_request_alone(api, trained):
    right = json.dumps(message(MOTION)).encode()
    assert refused(api.post(PATH, content=right[:-1]))
    assert api.post(PATH, content=right).status_code == 200


def test_the_first_wrong_number_of_a_batch_is_named(api, trained):
    wrong = [[0.0, 0.0], [0.0, 20.0], [-30.0, 0.0]]
    batch = {"inputs": [listed(name, wrong if name == "q" else np.zeros((3, 2))) for name in MOTION]}
    assert say(api, batch).startswith("q[2][0] is -30, expected radians")

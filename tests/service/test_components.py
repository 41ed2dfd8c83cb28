"""Components of a prediction over HTTP: what lipcore computes, shaped as the query, or a refusal that says why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from lipcore.data.motion import Motion
from lipcore.kernels.se import SquaredExponentialKernel
from lipcore.model import dynamics
from service.client import ApiError, Client
from service.foundation.settings import Settings
from service.inference import predicting
from service.inference.schema import PredictRequest
from tests.service.data import error, service_of

NAMES = [name for name in dynamics.COMPONENTS if name != "forward_dynamics"]
SHAPES = {"inertia_matrix": (2, 2), "kinetic_energy": (), "potential_energy": ()}


@pytest.fixture(scope="module")
def motion(trained):
    """Five instants of training."""
    return {name: getattr(trained.samples, name)[10:60:10] for name in ("q", "dq", "ddq")}


def post(api, model, motion, **request):
    body = {name: np.asarray(values).tolist() for name, values in motion.items()}
    return api.post(f"/v1/models/{model}/predict", json=body | request)


def ask(api, model, motion, **request):
    answer = post(api, model, motion, **request)
    assert answer.status_code == 200, answer.text
    return answer.json()


def refused(api, model, motion, **request):
    said = error(post(api, model, motion, **request), 422, "invalid_request")
    return said["detail"][0]


def test_components_are_those_of_lipcore(api, trained, motion):
    answer = ask(api, trained.name, motion, components=NAMES)
    expected = dynamics.components(trained.model, Motion.from_arrays(**motion), NAMES)
    assert list(answer["components"]) == NAMES
    for name, estimate in expected.items():
        found = answer["components"][name]
        assert set(found) == {"mean", "std"}
        scale = float(estimate.mean.abs().max())
        np.testing.assert_allclose(found["mean"], estimate.mean, rtol=1e-9, atol=1e-9 * scale)
        np.testing.assert_allclose(found["std"], estimate.std, rtol=1e-6, atol=1e-9 * scale)


def test_torques_sum_to_the_answer(api, trained, motion):
    answer = ask(api, trained.name, motion, components=["inertial", "coriolis", "gravity", "friction"])
    total = sum(np.array(values["mean"]) for values in answer["components"].values())
    np.testing.assert_allclose(total, answer["tau"], rtol=0, atol=1e-9)


@pytest.mark.parametrize("rows", [None, 1, 5])
def test_components_are_shaped_as_the_query(api, trained, motion, rows):
    query = {name: values[0] if rows is None else values[:rows] for name, values in motion.items()}
    answer = ask(api, trained.name, query, components=NAMES)
    lead = () if rows is None else (rows,)
    for name, values in answer["components"].items():
        assert np.shape(values["mean"]) == np.shape(values["std"]) == (*lead, *SHAPES.get(name, (2,))), name


def test_forward_dynamics_gives_the_acceleration_back(api, trained, motion):
    tau = ask(api, trained.name, motion)["tau"]
    answer = ask(api, trained.name, motion, components=["forward_dynamics"], tau=tau)
    found = answer["components"]["forward_dynamics"]
    np.testing.assert_allclose(found["mean"], motion["ddq"], atol=1e-6 * np.abs(motion["ddq"]).max())
    single = {name: values[2] for name, values in motion.items()}
    alone = ask(api, trained.name, single, components=["forward_dynamics"], tau=tau[2])
    np.testing.assert_allclose(alone["components"]["forward_dynamics"]["std"], found["std"][2], rtol=1e-6)


def test_components_are_left_out_unless_asked_for(api, trained, motion):
    plain = ask(api, trained.name, motion)
    assert "components" not in plain
    assert ask(api, trained.name, motion, components=[]) == plain
    with_them = ask(api, trained.name, motion, components=["gravity"])
    assert {name: value for name, value in with_them.items() if name != "components"} == plain


def test_the_shipped_model_knows_its_gravity(strict):
    query = {"q": [0, -0.5, 0, -2, 0, 1.5, 0.7], "dq": [0] * 7, "ddq": [0] * 7}
    answer = ask(strict, "panda-sim", query, components=["gravity", "friction", "kinetic_energy"])["components"]
    assert answer["kinetic_energy"]["mean"] == 0
    assert np.abs(answer["gravity"]["mean"]).max() > 10
    assert np.shape(answer["friction"]["std"]) == (7,)


@pytest.mark.parametrize(
    ("request_", "field", "value"),
    [
        pytest.param({"components": ["mass"]}, "components[0]", "mass", id="unknown"),
        pytest.param({"components": ["gravity", "gravity"]}, "components[1]", "gravity", id="twice"),
        pytest.param({"components": "gravity"}, "components", "gravity", id="no list"),
        pytest.param({"components": ["gravity", 3]}, "components[1]", "3", id="no name"),
        pytest.param({"components": ["forward_dynamics"]}, "tau", "missing", id="no torque"),
        pytest.param({"components": ["forward_dynamics"], "tau": None}, "tau", "missing", id="torque null"),
        pytest.param({"components": ["gravity"], "tau": [[0, 0]] * 5}, "tau", "given", id="torque in vain"),
        pytest.param({"tau": [[0, 0]] * 5}, "tau", "given", id="torque without components"),
        pytest.param(
            {"components": ["forward_dynamics"], "tau": [[0, 0]] * 4}, "tau", "of shape (4, 2)", id="too few torques"
        ),
        pytest.param(
            {"components": ["forward_dynamics"], "tau": [[0]] * 5}, "tau", "1 numbers long", id="too few joints"
        ),
        pytest.param({"components": ["forward_dynamics"], "tau": [["x", 0]]}, "tau[0][0]", "x", id="torque of text"),
    ],
)
def test_requests_that_are_refused(api, trained, motion, request_, field, value):
    said = refused(api, trained.name, motion, **request_)
    assert (said["field"], said["value"]) == (field, value)


def test_unknown_components_are_answered_with_those_there_are(api, trained, motion):
    expected = refused(api, trained.name, motion, components=["mass"])["expected"]
    for name in dynamics.COMPONENTS:
        assert name in expected


def test_batches_with_components_are_smaller(api, trained, motion):
    limit = service_of(api).settings.max_component_batch
    assert limit == 100
    many = {name: np.repeat(values[:1], limit + 1, axis=0) for name, values in motion.items()}
    said = refused(api, trained.name, many, components=["gravity"])
    assert (said["field"], said["value"]) == ("q", "101 queries")
    assert "at most 100" in said["expected"]
    most = {name: values[:limit] for name, values in many.items()}
    assert len(ask(api, trained.name, most, components=["gravity"])["components"]["gravity"]["mean"]) == limit


def test_components_that_an_estimator_lacks_are_refused_naming_what_it_offers(trained, motion):
    terms = {"torque": SquaredExponentialKernel(2), "friction": trained.model.estimator.terms["friction"]}
    black_box = replace(trained.model, estimator=replace(trained.model.estimator, name="se", terms=terms))
    request = PredictRequest.model_validate(
        {name: values.tolist() for name, values in motion.items()} | {"components": ["friction", "gravity"]}
    )
    with pytest.raises(Exception, match="components") as caught:
        predicting.check_components(black_box, request, Settings().max_component_batch)
    (problem,) = caught.value.detail
    assert (problem.field, problem.value) == ("components[1]", "gravity")
    assert problem.expected == "what a model with the estimator se offers: friction"


def test_inertia_that_cannot_be_inverted_is_refused_naming_the_query(api, trained, motion, monkeypatch):
    singular = torch.eye(2, dtype=torch.float64).repeat(5, 1, 1)
    singular[3, 1, 1] = -0.1
    monkeypatch.setattr(dynamics, "inertia_matrix", lambda *_: singular)
    said = refused(api, trained.name, motion, components=["forward_dynamics"], tau=[[0, 0]] * 5)
    assert said["field"] == "q[3]"
    assert "positive definite" in said["value"]


def test_the_client_passes_components_and_torque_on(server):
    zero = np.zeros(7)
    q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.7])
    with Client(server.url) as client:
        answer = client.predict("panda-sim", q, zero, zero, components=["gravity", "inertia_matrix"])
        assert list(answer.components) == ["gravity", "inertia_matrix"]
        assert np.shape(answer.components["inertia_matrix"].mean) == (7, 7)
        assert client.predict("panda-sim", q, zero, zero).components is None
        with pytest.raises(ApiError, match="tau is given"):
            client.predict("panda-sim", q, zero, zero, tau=zero)

"""Components of a prediction over HTTP: lipcore's values in the shape of the query, or an error that explains."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore.data.motion import Motion
from lipcore.kernels.independent import SquaredExponentialKernel
from lipcore.model import dynamics
from service.inference import predicting
from service.inference.predicting import MAX_COMPONENT_BATCH
from tests.service.data import error

NAMES = list(dynamics.COMPONENTS)
SHAPES = {"inertia_matrix": (2, 2), "kinetic_energy": (), "potential_energy": ()}


@pytest.fixture(scope="module")
def motion(trained):
    """Five states of the training data."""
    return {name: getattr(trained.samples, name)[10:60:10] for name in ("q", "dq", "ddq")}


def post(api, model, motion, **request):
    body = {name: np.asarray(values).tolist() for name, values in motion.items()}
    return api.post(f"/v1/models/{model}/predict", json=body | request)


def query_components(api, model, motion, **request):
    answer = post(api, model, motion, **request)
    assert answer.status_code == 200, answer.text
    return answer.json()


def rejection(api, model, motion, **request):
    reply = error(post(api, model, motion, **request), 422, "invalid_request")
    return reply["detail"][0]


@pytest.mark.parametrize("rows", [None, 1, 5])
def test_components_equal_lipcore_in_the_shape_of_the_query(api, trained, motion, rows):
    query = {name: values[0] if rows is None else values[:rows] for name, values in motion.items()}
    tau, states = 0.1 * query["q"], Motion.from_arrays(**query)
    answer = query_components(api, trained.name, query, components=NAMES, tau=tau.tolist())
    expected = dynamics.components(trained.model, states, NAMES, np.atleast_2d(tau))
    lead = () if rows is None else (rows,)
    assert list(answer["components"]) == NAMES
    for name, estimate in expected.items():
        result = answer["components"][name]
        assert set(result) == {"mean", "std"}
        scale = float(np.abs(estimate.mean).max())
        assert np.shape(result["mean"]) == np.shape(result["std"]) == (*lead, *SHAPES.get(name, (2,))), name
        mean, std = np.ravel(estimate.mean), np.ravel(estimate.std)
        np.testing.assert_allclose(np.ravel(result["mean"]), mean, rtol=1e-9, atol=1e-9 * scale)
        np.testing.assert_allclose(np.ravel(result["std"]), std, rtol=1e-5, atol=1e-9 * scale)


@pytest.mark.parametrize(
    ("request_", "field", "value"),
    [
        ({"components": ["forward_dynamics"]}, "tau", "missing"),
        ({"components": ["gravity"], "tau": [[0, 0]] * 5}, "tau", "given"),
        ({"components": ["forward_dynamics"], "tau": [[0, 0]] * 4}, "tau", "of shape (4, 2)"),
        ({"components": ["forward_dynamics"], "tau": [[0]] * 5}, "tau", "1 values"),
        ({"components": ["forward_dynamics"], "tau": [["x", 0]]}, "tau[0][0]", "x"),
    ],
)
def test_wrong_component_requests_are_rejected(api, trained, motion, request_, field, value):
    reply = rejection(api, trained.name, motion, **request_)
    assert (reply["field"], reply["value"]) == (field, value)


def test_batches_with_components_are_smaller(api, trained, motion):
    limit = MAX_COMPONENT_BATCH
    assert limit == 100
    many = {name: np.repeat(values[:1], limit + 1, axis=0) for name, values in motion.items()}
    reply = rejection(api, trained.name, many, components=["gravity"])
    assert (reply["field"], reply["value"]) == ("q", "101 queries")
    assert "at most 100" in reply["expected"]
    largest = {name: values[:limit] for name, values in many.items()}
    assert (
        len(query_components(api, trained.name, largest, components=["gravity"])["components"]["gravity"]["mean"])
        == limit
    )


def test_missing_component_error_lists_the_available_ones(trained):
    terms = {"torque": SquaredExponentialKernel(2), "friction": trained.model.estimator.terms["friction"]}
    black_box = replace(trained.model, estimator=replace(trained.model.estimator, name="se", terms=terms))
    with pytest.raises(Exception, match="components") as caught:
        predicting.check_offered(black_box, ["friction", "gravity"])
    (problem,) = caught.value.detail
    assert (problem.field, problem.value) == ("components[1]", "gravity")
    assert problem.expected == "a component of estimator se: friction"

"""Components of a prediction over HTTP: lipcore's values in the shape of the query, or an error that explains."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore.data.motion import Motion
from lipcore.kernels.independent import SquaredExponentialKernel
from lipcore.model import dynamics
from service.inference import predicting
from tests.service.data import error
from tests.service.models.versions import predict, predict_json

NAMES = list(dynamics.COMPONENTS)
SHAPES = {"inertia_matrix": (2, 2), "kinetic_energy": (), "potential_energy": ()}


@pytest.fixture(scope="module")
def motion(trained):
    """Five states of the training data."""
    return {name: getattr(trained.samples, name)[10:60:10] for name in ("q", "dq", "ddq")}


def rejection(api, model, **request):
    return error(predict(api, model, **request), 422, "invalid_request")["detail"][0]


@pytest.mark.parametrize("rows", [None, 1, 5])
def test_components_equal_lipcore_in_the_shape_of_the_query(api, trained, motion, rows):
    query = {name: values[0] if rows is None else values[:rows] for name, values in motion.items()}
    tau, states = 0.1 * query["q"], Motion.from_arrays(**query)
    answer = predict_json(api, trained.name, **query, components=NAMES, tau=tau)
    expected = dynamics.components(trained.model, states, NAMES, np.atleast_2d(tau))
    lead = () if rows is None else (rows,)
    assert list(answer["components"]) == NAMES
    for name, estimate in expected.items():
        result = answer["components"][name]
        assert set(result) == {"mean", "std"}
        scale = float(np.abs(estimate.mean).max())
        for part, rtol in (("mean", 1e-9), ("std", 1e-5)):
            assert np.shape(result[part]) == (*lead, *SHAPES.get(name, (2,))), name
            values = np.ravel(getattr(estimate, part))
            np.testing.assert_allclose(np.ravel(result[part]), values, rtol=rtol, atol=1e-9 * scale)


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
    reply = rejection(api, trained.name, **motion, **request_)
    assert (reply["field"], reply["value"]) == (field, value)


def test_batches_with_components_are_smaller(api, trained, motion):
    limit = 100
    many = {name: np.repeat(values[:1], limit + 1, axis=0) for name, values in motion.items()}
    reply = rejection(api, trained.name, **many, components=["gravity"])
    assert (reply["field"], reply["value"]) == ("q", "101 queries")
    assert "at most 100" in reply["expected"]
    largest = {name: values[:limit] for name, values in many.items()}
    answer = predict_json(api, trained.name, **largest, components=["gravity"])
    assert len(answer["components"]["gravity"]["mean"]) == limit


def test_missing_component_error_lists_the_available_ones(trained):
    terms = {"torque": SquaredExponentialKernel(2), "friction": trained.model.estimator.terms["friction"]}
    black_box = replace(trained.model, estimator=replace(trained.model.estimator, name="se", terms=terms))
    with pytest.raises(Exception, match="components") as caught:
        predicting.check_offered(black_box, ["friction", "gravity"])
    (problem,) = caught.value.detail
    assert (problem.field, problem.value) == ("components[1]", "gravity")
    assert problem.expected == "a component of estimator se: friction"

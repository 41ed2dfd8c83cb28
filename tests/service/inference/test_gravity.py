"""Gravity over HTTP: lipcore's component without dq and ddq, or an error that explains."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lipcore import load
from lipcore.data.motion import Motion
from lipcore.model import dynamics
from lipserve import ApiError
from service.contract.wrench import GravityRequest
from service.foundation.errors import InvalidRequestError
from service.foundation.settings import Settings
from service.inference.gravity import gravity
from service.models.loads import StreamPayloads
from service.models.scales import Scales
from service.models.served import ServedModel
from tests import ROOT
from tests.clients.python.conftest import over
from tests.service.data import error

URL = "/v1/models/panda-sim/gravity"
Q = np.random.default_rng(1).uniform([-1, -1, -1, -2, -1, 1, -1], [1, 1, 1, -1, 1, 2, 1], (5, 7))
PAYLOAD = {"mass": 2.0, "com": [0.0, 0.0, 0.1]}


@pytest.fixture(scope="module")
def panda():
    return load(ROOT / "models/panda-sim")


@pytest.mark.parametrize("rows", [None, 1, 5])
def test_gravity_is_the_component_in_the_shape_of_the_query(api, panda, rows):
    q = Q[0] if rows is None else Q[:rows]
    answer = api.post(URL, json={"q": q.tolist()}).json()
    states = np.atleast_2d(q)
    expected = dynamics.components(panda, Motion(states, 0 * states, 0 * states), ["gravity"])["gravity"]
    for part, rounding in (("mean", 1e-9), ("std", 1e-7)):  # std is the root of a small difference of variances
        assert np.shape(answer[part]) == q.shape
        np.testing.assert_allclose(np.atleast_2d(answer[part]), getattr(expected, part), rtol=1e-6, atol=rounding)
    assert (answer["model"], answer["version"], answer["joint_names"]) == ("panda-sim", 1, list(panda.joint_names))


def test_payload_adds_its_weight(api):
    alone, carried = (api.post(URL, json={"q": Q.tolist()} | more).json() for more in ({}, {"payload": PAYLOAD}))
    assert (np.abs(np.subtract(carried["mean"], alone["mean"])).max(axis=0)[1:6] > 0.1).all()


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({"q": [0.0] * 6}, "q"),
        ({"q": [[0.0] * 7] * 101}, "q"),
        ({"q": [0.0, 40.0, 0.0, 0.0, 0.0, 0.0, 0.0]}, "q[1]"),
        ({"q": [0.0] * 7, "dq": [0.0] * 7}, "dq"),
        ({}, "q"),
    ],
)
def test_wrong_requests_are_rejected(api, body, field):
    assert error(api.post(URL, json=body), 422, "invalid_request")["detail"][0]["field"] == field


def test_models_without_gravity_say_so(panda):
    request, scales = GravityRequest(q=[0.0] * 7), Scales(panda.scale)
    storage = SimpleNamespace(settings=Settings())
    compensated = replace(panda, torque_convention="gravity_compensated")
    black_box = replace(panda, estimator=replace(panda.estimator, name="se"))
    for model, message in ((compensated, "trained on torque without gravity"), (black_box, "its estimator is se")):
        with pytest.raises(InvalidRequestError, match=message):
            gravity(storage, ServedModel("arm", 1, model, model, frozenset(), scales, StreamPayloads()), request)


def test_client_returns_parts_that_sum_to_the_torque(api, panda):
    rng = np.random.default_rng(2)
    dq, ddq = rng.uniform(-1, 1, (2, 5, 7))
    with over(api._transport) as client:
        whole = client.predict("panda-sim", Q, dq, ddq, components=["friction", "without_gravity"])
        held, moving, matrix = (
            client.gravity("panda-sim", Q),
            client.coriolis("panda-sim", Q, dq),
            client.mass_matrix("panda-sim", Q),
        )
        inertial = (matrix.mean @ ddq[..., None])[..., 0]
        friction, rest = whole.components["friction"].mean, whole.components["without_gravity"]
        np.testing.assert_allclose(inertial + moving.mean + held.mean + friction, whole.tau, atol=1e-7)
        np.testing.assert_allclose(rest.mean, whole.tau - held.mean, atol=1e-7)
        expected = dynamics.components(panda, Motion(Q, dq, ddq), ["without_gravity"])["without_gravity"]
        np.testing.assert_allclose(rest.std, expected.std, rtol=1e-5)
        assert matrix.mean.shape == (5, 7, 7)
        with pytest.raises(ApiError, match="7 joints"):
            client.gravity("panda-sim", [0.0])

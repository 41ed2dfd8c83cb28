"""Wrench over HTTP: that of lipcore, in the shape of the query, or an error that explains."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lipcore import TorqueModel, load
from lipcore.estimators.catalogue import make_estimator
from lipcore.model.wrench import external_wrench
from lipserve import ApiError
from service.contract.wrench import WrenchRequest
from service.foundation.errors import InvalidRequestError
from service.inference.wrench import wrench
from service.models.loads import StreamPayloads
from service.models.scales import Scales
from service.models.served import ServedModel
from tests import ROOT
from tests.clients.python.conftest import over
from tests.service.data import error

Q = np.array([[0.1, -0.4, 0.2, -1.8, 0.3, 1.6, 0.3], [0.3, -0.2, 0.1, -1.5, 0.4, 1.4, 0.0]])
POSE = np.array([[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.2], [0.0, 0.0, 0.0, 1.0]])
URL = "/v1/models/panda-sim/wrench"


STORAGE: Any = SimpleNamespace(settings=SimpleNamespace(max_position=30.0))


def served(model: TorqueModel) -> ServedModel:
    """Return a version with this model, and twice its width factors."""
    return ServedModel("arm", 3, model, model, frozenset(), Scales(2.0 * model.scale), StreamPayloads(), 7)


@pytest.fixture(scope="module")
def known() -> TorqueModel:
    """The shipped Panda, as if its geometry were that of a URDF."""
    learnt = load(ROOT / "models/panda-sim")
    assert learnt.arm is not None
    arm = replace(learnt.arm, mode="fixed", expected=np.zeros(0), widths=np.zeros(0))
    return replace(learnt, estimator=make_estimator("rigid-body", learnt.joint_types, arm=arm))


@pytest.mark.parametrize("tool", [None, POSE])
@pytest.mark.parametrize("single", [False, True])
def test_wrench_is_that_of_lipcore_in_the_shape_of_the_query(known, single, tool):
    tau = known.predict(Q, 0.1 * Q, 0.2 * Q).tau + 1.0
    parts = {"q": Q, "dq": 0.1 * Q, "ddq": 0.2 * Q, "tau": tau}
    body = {name: (values[0] if single else values).tolist() for name, values in parts.items()}
    answer = wrench(STORAGE, served(known), WrenchRequest(**body, tool=None if tool is None else tool.tolist()))
    assert (answer.model, answer.version, answer.revision) == ("arm", 3, 7)
    for row in range(1 if single else 2):
        motion = np.stack([Q[row], 0.1 * Q[row], 0.2 * Q[row]])
        expected = external_wrench(known, motion, tau[row], 2.0 * known.scale, tool)
        for part in ("link", "base", "link_covariance", "base_covariance"):
            values = getattr(answer, part) if single else getattr(answer, part)[row]
            np.testing.assert_allclose(values, getattr(expected, part), rtol=1e-9)


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "pose of another shape": ({"tool": [[1.0]]}, "of shape"),
    "pose that is no rotation": ({"tool": (2.0 * POSE).tolist()}, "not a pose"),
    "singular posture": ({"q": [0.0] * 7}, "a singular posture"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_requests_say_why(known, name):
    zero = dict.fromkeys(("dq", "ddq", "tau"), [0.0] * 7)
    body, value = WRONG[name]
    with pytest.raises(InvalidRequestError) as caught:
        wrench(STORAGE, served(known), WrenchRequest(**({"q": Q[0].tolist()} | zero | body)))
    assert str(caught.value.detail[0].value).startswith(value)


def test_model_with_a_learnt_geometry_says_what_to_do(api):
    body = {name: [0.1] * 7 for name in ("q", "dq", "ddq", "tau")}
    refusal = error(api.post(URL, json=body), 422, "invalid_request")
    assert "train it with a URDF" in refusal["message"]
    assert error(api.post(URL, json=body | {"tau": None}), 422, "invalid_request")["detail"][0]["field"] == "tau"
    with over(api._transport) as client, pytest.raises(ApiError, match="train it with a URDF"):
        client.wrench("panda-sim", *np.full((4, 7), 0.1), tool=POSE)

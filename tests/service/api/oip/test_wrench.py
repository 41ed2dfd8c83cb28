"""Wrench outputs: those of lipcore for models with the geometry of a URDF, errors that explain for others."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from lipcore import TorqueModel, load
from lipcore.estimators.catalogue import make_estimator
from lipcore.model.wrench import external_wrench
from service.api.oip import query
from service.foundation.errors import InvalidRequestError
from service.inference.predicting import Query
from tests import ROOT

Q = np.array([[0.1, -0.4, 0.2, -1.8, 0.3, 1.6, 0.3], [0.3, -0.2, 0.1, -1.5, 0.4, 1.4, 0.0]])
MOTION = np.stack([Q, 0.1 * Q, 0.2 * Q])


@dataclass
class Served:
    """A version in memory."""

    default_model: TorqueModel

    @property
    def scales(self) -> Any:
        return self

    def of(self, _: None) -> np.ndarray:
        return self.default_model.scale


@pytest.fixture(scope="module")
def known() -> TorqueModel:
    """The shipped Panda, as if its geometry were that of a URDF."""
    learnt = load(ROOT / "models/panda-sim")
    assert learnt.arm is not None
    arm = replace(learnt.arm, mode="fixed", expected=np.zeros(0), widths=np.zeros(0))
    return replace(learnt, estimator=make_estimator("rigid-body", learnt.joint_types, arm=arm))


def task(values: np.ndarray, *outputs: str) -> query.InferTask:
    return query.InferTask(Query(values, False), dict.fromkeys(outputs, False))


def test_outputs_are_the_wrench_of_lipcore(known):
    tau = known.predict(*MOTION).tau + 1.0
    found = query.compute(Served(known), task(np.concatenate([MOTION, tau[None]]), "tau", *query.WRENCH_OUTPUTS))
    assert set(found) >= {"tau", *query.WRENCH_OUTPUTS}
    for row in range(2):
        expected = external_wrench(known, MOTION[:, row], tau[row])
        for name, part in query.WRENCH_OUTPUTS.items():
            np.testing.assert_allclose(found[name][row], getattr(expected, part), rtol=1e-12)
            assert query.shapes(known)[name] == (-1, 6)


def test_singular_posture_is_named(known):
    straight = np.zeros((4, 2, 7))
    straight[0, 0] = Q[0]
    with pytest.raises(InvalidRequestError, match=r"At `q\[1\]`, the posture is singular"):
        query.compute(Served(known), task(straight, "wrench_base"))


def test_model_with_a_learnt_geometry_has_no_wrench(api):
    names = ("q", "dq", "ddq", "tau")
    inputs = [{"name": name, "shape": [7], "datatype": "FP64", "data": [0.1] * 7} for name in names]
    answer = api.post("/v2/models/panda-sim/infer", json={"inputs": inputs, "outputs": [{"name": "wrench_base"}]})
    assert answer.status_code == 400
    assert "outputs[0].name" in answer.text
    assert "wrench_base" not in [each["name"] for each in api.get("/v2/models/panda-sim").json()["outputs"]]

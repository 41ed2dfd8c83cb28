"""Friction that slow joints have besides: learnt where a recording shows it, and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from lipcore import FitOptions, Samples, TorqueModel
from lipcore.arm import learning
from lipcore.data.motion import Motion
from lipcore.files.arm import arm_tensors, read_arm
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import Alternative
from lipcore.kernels.geometry import Geometry
from lipcore.model.parameters import friction_coefficients
from lipcore.online.learner import OnlineModel
from lipcore.robots.library import random_arm
from lipcore.robots.simulation import Stream, simulate
from tests.lipcore.arm_oracles import followed
from tests.lipcore.online_checks import as_rows
from tests.lipcore.test_arm_model import errors

ROBOT = random_arm(1, joints=3)
PLACES = tuple(ROBOT.model.jointPlacements)[1:]
GEOMETRY = Geometry(
    ROBOT.joint_types,
    np.array([place.rotation for place in PLACES]),
    np.array([place.translation for place in PLACES]),
    np.tile([0.0, 0.0, 1.0], (3, 1)),
    ROBOT.model.gravity.linear.copy(),
)
OPTIONS = FitOptions(device="cpu")
STREAM = Stream(300, n_sinusoids=30, speed=5.0, noise=0.05, viscous=0.3)


def recorded(seed: int, stribeck: float) -> Samples:
    """Slow motion with Coulomb friction, 0.4 N·m, and more of it at low speed."""
    samples = simulate(ROBOT, STREAM, seed)
    fading = 0.4 + stribeck * np.exp(-((samples.dq / 0.1) ** 2))
    return replace(samples, tau=samples.tau + fading * np.tanh(samples.dq / 0.02))


def trained(stribeck: float) -> TorqueModel:
    return followed(GEOMETRY, ROBOT, recorded(1, stribeck), OPTIONS)


@pytest.fixture(scope="module")
def model() -> TorqueModel:
    return trained(0.5)


def test_it_is_learnt_where_there_is_some(model: TorqueModel, monkeypatch: pytest.MonkeyPatch) -> None:
    assert model.fit["friction_terms"] == 4
    assert float(model.fit["stribeck_nats"]) > 10
    friction = friction_coefficients(model.posterior, model.estimator)
    assert friction.stribeck is not None
    assert (np.abs(friction.stribeck - 0.5) < 3 * friction.stribeck_std).all()
    assert (friction.stribeck_std < 0.1).all()
    monkeypatch.setattr(learning, "STRIBECK_NATS", np.inf)
    without, unseen = trained(0.5), recorded(2, 0.5)
    assert without.fit["friction_terms"] == 3
    assert errors(model, unseen).mean() < 0.8 * errors(without, unseen).mean()


def test_it_is_not_learnt_where_there_is_none() -> None:
    model = trained(0.0)
    assert model.fit["friction_terms"] == 3
    assert float(model.fit["stribeck_nats"]) < 2
    assert friction_coefficients(model.posterior, model.estimator).stribeck is None


def test_alternative_arms_have_it_too(model: TorqueModel) -> None:
    known = model.arm
    assert known is not None
    rng, given = np.random.default_rng(0), (known.geometry, known.parameters)
    each = [Alternative(*given, rng.random(3), rng.random((3, 4)), share) for share in (0.7, 0.3)]
    both = replace(known, alternatives=tuple(each))
    again = read_arm(arm_tensors(both), ROBOT.joint_types, both.mode)
    assert again.stribeck
    np.testing.assert_array_equal(again.alternatives[1].friction, each[1].friction)
    kernel = ArmKernel(again)
    dq = torch.tensor([[0.05, -0.05, 0.5]]).double()
    fading = np.tanh(dq.numpy() / 0.02) * np.exp(-((dq.numpy() / 0.1) ** 2))
    still = Motion(dq * 0, dq, dq * 0)
    less = replace(each[1], friction=each[1].friction * [1, 1, 1, 0])
    other = ArmKernel(replace(both, alternatives=(each[0], less)))
    differ = (kernel.mean(still) - other.mean(still)).numpy()
    np.testing.assert_allclose(differ, 0.3 * fading * each[1].friction[:, 3], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("values", [[0.5], [], [float("nan")]])
def test_a_flag_that_is_none_is_refused(model: TorqueModel, values: list[float]) -> None:
    known = model.arm
    assert known is not None
    tensors = arm_tensors(known) | {"arm/stribeck": torch.tensor(values, dtype=torch.float64)}
    with pytest.raises(ValueError, match="'arm/stribeck' is"):
        read_arm(tensors, ROBOT.joint_types, known.mode)
    assert not read_arm(tensors | {"arm/stribeck": torch.zeros(1)}, ROBOT.joint_types, known.mode).stribeck


def test_it_is_learnt_online(model: TorqueModel) -> None:
    online = OnlineModel.start(model, forgetting_s=None).change(-1.0)
    learnt, unseen = online.learn(as_rows(recorded(5, 1.0), began=0.0)).model(), recorded(6, 1.0)
    assert (errors(learnt, unseen) < errors(model, unseen)).all()
    friction = friction_coefficients(learnt.posterior, learnt.estimator)
    assert friction.stribeck is not None
    assert (friction.stribeck > 0.7).all()

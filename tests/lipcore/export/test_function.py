"""Tests of a model as a pure function: NumPy, PyTorch and JAX compute the model's answers and their derivatives."""

from functools import partial
from typing import Any

import jax
import numpy as np
import pytest
import torch
from torch.func import jacrev, vmap

from lipcore import FitOptions, TorqueModel, train
from lipcore.data.motion import Array
from lipcore.export.function import function
from lipcore.kernels.drive.play import PlayState, element_widths
from tests.choosing import few
from tests.lipcore.arm_oracles import arm, record_motion
from tests.lipcore.export.models import MODELS, draw_motions
from tests.lipcore.oracles import central_difference

OPTIONS = FitOptions(device="cpu", statistics="chosen", max_iterations=3, starts=1, max_inducing_outputs=20)
TOLERANCE = 1e-10
"""Max deviation from the model, relative to the largest value."""

jax.config.update("jax_enable_x64", True)

ESTIMATORS = ("lip", "lip-chain", "se", "gip", "lse")


def train_estimator(estimator: str) -> TorqueModel:
    _, _, robot = arm("RP", 51)
    return train(record_motion(robot, 1, 60), robot.joint_types, estimator, OPTIONS)


ALL = MODELS | {name: partial(train_estimator, name) for name in ESTIMATORS}


def assert_equal(found: Any, expected: Array, tolerance: float = TOLERANCE) -> None:
    np.testing.assert_allclose(np.asarray(found), expected, rtol=0, atol=tolerance * np.abs(expected).max())


@pytest.mark.parametrize("name", few(ALL, kept=lambda name: name in ("panda", "friction of all kinds, alternatives")))
def test_every_library_computes_the_answers_of_the_model(name: str) -> None:
    model = ALL[name]()
    answer, motion = function(model), draw_motions(model, 20, 1, 1.5)
    expected, tolerance = model.predict(*motion), 1e-6 if name in ESTIMATORS else 1e-9
    for convert in (np.asarray, torch.from_numpy):
        query = [convert(part) for part in motion]
        tau, std = answer(*query)
        assert type(tau) is type(std) is type(query[0])
        assert_equal(tau, expected.mean, tolerance)
        np.testing.assert_allclose(np.asarray(std), expected.tau_std, rtol=tolerance)
        assert_equal(answer.torque(*query), expected.mean, tolerance)
    single = [torch.from_numpy(part).float() for part in motion]
    if len(model.posterior.basis.outputs):
        with pytest.raises(ValueError, match=r"q is torch\.float32, expected float64"):
            answer(*single)
        return
    tau, std = answer(*single)
    assert tau.dtype == std.dtype == torch.float32
    assert_equal(tau, expected.mean, 1e-4)
    assert_equal(std, expected.tau_std, 1e-3)


def test_joints_are_counted() -> None:
    answer = function(MODELS["panda"]())
    with pytest.raises(ValueError, match=r"q has shape \(6,\), expected \(..., 7\): panda_joint1"):
        answer(*np.zeros((3, 6)))


@pytest.mark.parametrize("name", few(MODELS, kept=lambda name: name == "friction of all kinds"))
def test_derivatives_equal_differences(name: str) -> None:
    model = MODELS[name]()
    answer, motion = function(model), draw_motions(model, 3, 2)

    def shifted(place: int, joint: int, step: float) -> Array:
        moved = motion.copy()
        moved[place, :, joint] += step
        return np.stack([model.predict(*moved).mean, model.predict(*moved).tau_std])

    expected = np.array(
        [
            [central_difference(partial(shifted, place, joint), 1e-5) for joint in range(model.n_joints)]
            for place in range(3)
        ]
    )  # by part of the motion, joint, kind of result, sample, torque
    slopes = vmap(jacrev(answer, argnums=(0, 1, 2)))(*map(torch.from_numpy, motion))
    found = np.stack([[each[place].numpy() for each in slopes] for place in range(3)])
    bound = 1e-6 * np.abs(expected).max(axis=(0, 1, 3, 4), keepdims=True)
    assert (np.abs(found.transpose(0, 4, 1, 2, 3) - expected) < bound).all()


def test_jax_compiles_maps_and_differentiates() -> None:
    model = MODELS["friction of all kinds"]()
    answer, motion = function(model), draw_motions(model, 4, 3)
    expected = model.predict(*motion)
    query = [jax.numpy.asarray(part) for part in motion]
    tau, std = jax.jit(jax.vmap(answer))(*query)
    assert_equal(tau, expected.mean)
    assert_equal(std, expected.tau_std)
    slopes = jax.jit(jax.grad(lambda *each: answer.torque(*each).sum(), argnums=2))(*query)
    leaf = torch.from_numpy(motion[2]).requires_grad_()
    answer.torque(*map(torch.from_numpy, motion[:2]), leaf).sum().backward()
    assert_equal(slopes, leaf.grad.numpy())


def test_drive_state_follows_the_motion() -> None:
    model = MODELS["friction of all kinds"]()
    answer, n, rng = function(model), model.n_joints, np.random.default_rng(4)
    time, dq = 0.01 * np.arange(60), 0.2 * np.sin(0.3 * np.arange(60))[:, None] * rng.uniform(0.5, 1.0, n)
    q, ddq = np.cumsum(0.01 * dq, axis=0), rng.standard_normal((60, n))
    deflections, _ = PlayState.unknown(n).follow(time, q, dq, element_widths(model.joint_types))
    expected = model.predict(q, dq, ddq, deflections=deflections)
    for convert in (np.asarray, torch.from_numpy):
        state, torques, deviations = answer.drive_start(convert(q[0])), [], []
        for k in range(60):
            state = answer.drive_step(convert(q[k]), state)
            tau, std = answer(*(convert(each[k]) for each in (q, dq, ddq)), state)
            torques.append(np.asarray(tau))
            deviations.append(np.asarray(std))
        assert_equal(torques, expected.mean)
        np.testing.assert_allclose(deviations, expected.tau_std, rtol=1e-7)
    assert answer.remembers
    assert not function(MODELS["panda"]()).remembers

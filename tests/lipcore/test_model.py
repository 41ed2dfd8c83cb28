"""Training and asking a model: what it refuses, and what an answer is made of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lipcore import FitOptions, Samples, TorqueModel, train
from lipcore.fitting.estimators import ESTIMATORS, UnknownEstimatorError
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Stream, simulate

JOINT_TYPES = ("revolute", "revolute")
OPTIONS = FitOptions(
    hyperparameter_samples=20, posterior_samples=50, max_iterations=10, starts=1, device="cpu", statistics="chosen"
)


@pytest.fixture(scope="module")
def samples() -> Samples:
    return simulate(load_robot("double-pendulum"), Stream(n_samples=60, speed=10, noise=0.01), seed=1)


@pytest.fixture(scope="module")
def model(samples: Samples) -> TorqueModel:
    return train(samples, JOINT_TYPES, "lip-chain", OPTIONS)


def test_answer_for_many_is_the_answers_for_each(model: TorqueModel, samples: Samples) -> None:
    many = model.predict(samples.q, samples.dq, samples.ddq, covariance=True)
    assert many.tau.shape == many.tau_std.shape == (60, 2)
    assert many.covariance.shape == (60, 2, 2)
    assert many.noise_std.shape == (2,)
    for k in (0, 31, 59):
        one = model.predict(samples.q[k], samples.dq[k], samples.ddq[k], covariance=True)
        assert np.allclose(one.tau[0], many.tau[k], rtol=1e-8, atol=1e-10)
        assert np.allclose(one.covariance[0], many.covariance[k], rtol=1e-6, atol=1e-12)
    assert np.allclose(many.tau_std**2, np.diagonal(many.covariance, axis1=1, axis2=2), rtol=1e-12)


def test_model_says_what_it_was_made_of(model: TorqueModel, samples: Samples) -> None:
    assert model.joint_names == samples.joint_names
    assert model.joint_types == JOINT_TYPES
    assert model.torque_convention == "gravity_included"
    assert model.options["hyperparameter_samples"] == 20
    assert model.fit["samples_posterior"] == model.posterior.statistics.samples == 50
    basis = model.posterior.basis
    sizes = model.compact["inducing_outputs"], model.compact["inducing_samples"], model.compact["weights"]
    assert sizes == (len(basis.outputs), len(basis.inducing), len(basis))
    assert model.compact["tolerance_reached"] is True


def test_training_range_is_that_of_the_samples_it_stands_on(samples: Samples) -> None:
    every = train(samples, JOINT_TYPES, "lip-chain", replace(OPTIONS, posterior_samples=len(samples), max_iterations=1))
    assert set(every.training_range) == {"q", "dq", "ddq"}
    for name, limits in every.training_range.items():
        values = getattr(samples, name)
        assert limits == {"min": values.min(0).tolist(), "max": values.max(0).tolist()}


def test_inducing_samples_are_rows_of_the_data(model: TorqueModel, samples: Samples) -> None:
    rows = {tuple(row) for row in np.hstack([samples.q, samples.dq, samples.ddq])}
    inducing = model.posterior.basis.inducing
    assert {tuple(row) for row in np.hstack([inducing.q, inducing.dq, inducing.ddq])} <= rows


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        (((4, 3),) * 3, "q has 3 joints, expected 2: joint1, joint2"),
        (((3,),) * 3, "q has 3 joints, expected 2"),
        (((4, 2), (4, 2), (3, 2)), r"ddq has shape \(3, 2\), expected \(4, 2\)"),
        (((4, 2, 2),) * 3, "q"),
    ],
    ids=str,
)
def test_query_of_wrong_shape_is_refused(model: TorqueModel, shapes: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        model.predict(*(np.zeros(shape) for shape in shapes))


def test_query_that_is_not_finite_is_refused(model: TorqueModel) -> None:
    with pytest.raises(ValueError, match=r"dq\[0, 1\] is nan"):
        model.predict([0.0, 0.0], [0.0, np.nan], [0.0, 0.0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"joint_types": ("revolute",)}, "joint_types has 1 entries, expected 2"),
        ({"joint_types": ("revolute", "spherical")}, r"joint_types\[1\] is 'spherical'"),
        ({"torque_convention": "none"}, "torque_convention is 'none', expected one of gravity_included"),
        ({"estimator": "oracle"}, "estimator is 'oracle', expected one of auto, lip"),
    ],
    ids=str,
)
def test_bad_argument_of_training_is_named(samples: Samples, arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        train(samples, **({"joint_types": JOINT_TYPES, "estimator": "lip-chain", "options": OPTIONS} | arguments))


@pytest.mark.parametrize("name", ["q", "dq", "ddq", "tau"])
def test_samples_that_are_not_finite_are_named(samples: Samples, name: str) -> None:
    values = getattr(samples, name).copy()
    values[3, 1] = np.nan
    with pytest.raises(ValueError, match=rf"{name}\[3, 1\]"):
        train(replace(samples, **{name: values}), JOINT_TYPES, "lip-chain", OPTIONS)


def test_unknown_estimator_has_its_own_error(samples: Samples) -> None:
    with pytest.raises(UnknownEstimatorError) as caught:
        train(samples, JOINT_TYPES, estimator="oracle")
    assert all(name in str(caught.value) for name in ESTIMATORS)


def test_a_torque_that_never_changes_is_learnt_as_offset(samples: Samples) -> None:
    constant = replace(samples, tau=np.full_like(samples.tau, 3.0))
    trained = train(constant, JOINT_TYPES, "lip-chain", FitOptions(max_iterations=60, device="cpu"))
    answer = trained.predict(samples.q, samples.dq, samples.ddq)
    assert np.abs(answer.tau - 3.0).max() < 1e-2
    assert trained.fit["jitter"] == 0.0

"""The calibration of a model: every standard deviation of the function times one factor, and nothing else."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike

from lipcore import FitOptions, Samples, TorqueModel, load, save, train
from lipcore.fitting.estimators import FUNCTION_STD_FACTOR, NO_CALIBRATION, Calibration, calibrate
from lipcore.model import dynamics
from lipcore.model.parameters import friction_coefficients, inertial_parameters, weight_posterior
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Stream, simulate
from lipcore.robots.urdf import RigidBody
from lipcore.training import fit

FACTOR = 1.75
SAME = 1e-6
"""Share of the largest number by which two fits to the same samples may differ."""
OPTIONS = FitOptions(hyperparameter_samples=30, max_iterations=20, starts=1, device="cpu", prior="zero")


@pytest.fixture(scope="module")
def samples() -> Samples:
    return simulate(load_robot("double-pendulum"), Stream(n_samples=60, speed=10, noise=1e-4, viscous=0.1), seed=1)


@pytest.fixture(scope="module", params=["lip-chain", "lip", "rigid-body"])
def plain(request: pytest.FixtureRequest, samples: Samples) -> TorqueModel:
    robot = None
    if request.param == "rigid-body":
        robot = RigidBody.from_profile("double-pendulum", samples.joint_names, ("revolute",) * 2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit, "calibrate", lambda name: NO_CALIBRATION)
        return train(samples, ("revolute",) * 2, request.param, OPTIONS, robot=robot)


@pytest.fixture(scope="module")
def corrected(plain: TorqueModel, samples: Samples) -> TorqueModel:
    """The same training, with a factor for its estimator."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(FUNCTION_STD_FACTOR, plain.estimator.name, FACTOR)
        return train(samples, plain.joint_types, plain.estimator.name, OPTIONS, robot=plain.robot)


def alike(found: ArrayLike, expected: ArrayLike) -> None:
    """Assert that what two fits say is the same but for rounding, which the steps of a search magnify."""
    np.testing.assert_allclose(found, expected, rtol=0, atol=SAME * np.abs(np.asarray(expected)).max())


def test_predictions(plain: TorqueModel, corrected: TorqueModel, samples: Samples) -> None:
    assert corrected.calibration == Calibration(FACTOR)
    query = samples.q + 0.3, samples.dq, 2 * samples.ddq
    one, other = (model.predict(*query, covariance=True) for model in (plain, corrected))
    alike(other.tau, one.tau)
    alike(other.noise_std, one.noise_std)
    alike(other.tau_std, FACTOR * one.tau_std)
    alike(other.covariance, FACTOR**2 * one.covariance)
    assert (one.tau_std > 0).all()


def test_components(plain: TorqueModel, corrected: TorqueModel, samples: Samples) -> None:
    motion, tau = samples.motion()[10:15], samples.torque()[10:15]
    one, other = (dynamics.components(m, motion, dynamics.COMPONENTS, tau) for m in (plain, corrected))
    for name in dynamics.COMPONENTS:
        alike(other[name].mean, one[name].mean)
        alike(other[name].std, FACTOR * one[name].std)
        assert (one[name].std > 0).any(), name


def test_parameters(plain: TorqueModel, corrected: TorqueModel) -> None:
    one, other = (friction_coefficients(m.posterior, m.estimator) for m in (plain, corrected))
    for name in ("viscous", "coulomb", "offset"):
        alike(getattr(other, name), getattr(one, name))
        alike(getattr(other, f"{name}_std"), FACTOR * getattr(one, f"{name}_std"))
    if plain.robot is not None:
        bodies, scaled = (inertial_parameters(m.posterior, m.estimator) for m in (plain, corrected))
        alike(scaled.mean, bodies.mean)
        alike(scaled.std, FACTOR * bodies.std)
        weights, more = (weight_posterior(m.posterior, m.estimator.terms["rigid_body"]) for m in (plain, corrected))
        assert np.array_equal(weights.scale, more.scale)  # the prior's own


def test_it_is_saved_and_loaded(corrected: TorqueModel, samples: Samples, tmp_path: Path) -> None:
    manifest = save(corrected, tmp_path / "model")
    assert manifest["calibration"] == {"function_std_factor": FACTOR}
    again = load(tmp_path / "model")
    assert again.calibration == corrected.calibration
    query = samples.q, samples.dq, samples.ddq
    for name in ("tau", "tau_std", "covariance", "noise_std"):
        assert np.array_equal(getattr(again.predict(*query), name), getattr(corrected.predict(*query), name)), name
    # what a model was saved with counts, not what its estimator has by now
    assert calibrate(corrected.estimator.name).function_std_factor != FACTOR


@pytest.mark.parametrize("factor", [0.999, 0.0, -2.0, float("nan"), float("inf"), 100.0])
def test_factor_out_of_range_is_refused(factor: float) -> None:
    with pytest.raises(ValueError, match=f"function_std_factor is {factor!r}, expected a number from 1 to 100"):
        Calibration(factor)

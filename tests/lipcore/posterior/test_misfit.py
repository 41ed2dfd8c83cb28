"""Tests of the misfit: estimated from residuals, added to predictions, and counted in learning."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lipcore import FitOptions, Samples, TorqueModel, load, save
from lipcore.arm.learning import learn
from lipcore.data.independence import INDEPENDENT_HZ
from lipcore.data.metrics import evaluate
from lipcore.data.motion import Array, Motion
from lipcore.estimators.task import Task
from lipcore.kernels.drive.play import deflections_at
from lipcore.kernels.fast.answer import ACCELERATED, MISFIT_ROWS
from lipcore.kernels.geometry import Geometry
from lipcore.model.parameters import friction_coefficients
from lipcore.posterior.misfit import OPTIONS, Misfit, estimate_misfit, low_speed_variance, shared_rows
from lipcore.robots.dirt import Dirt
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from lipcore.robots.urdf import RigidBody
from lipcore.training.fit import fit_estimator
from tests.lipcore.estimators.test_estimators import train_estimator

TYPES = ("revolute",) * 2
ROBOT = load_robot("double-pendulum")
STREAM = Simulation(n_samples=1000, rate=50.0, speed=5.0, noise=0.0)
QUICK_OPTIONS = FitOptions(hyperparameter_samples=40, posterior_samples=200, max_iterations=20, starts=1, device="cpu")


def simulate_dirty(seed: int, **changes: object) -> Samples:
    return simulate(ROBOT, replace(STREAM, dirt=Dirt(seed=5), **changes), seed)  # type: ignore[arg-type]


@pytest.fixture(scope="module", params=["rigid-body", "lip-chain"])
def model(request: pytest.FixtureRequest) -> TorqueModel:
    return train_estimator(request.param, simulate_dirty(1), QUICK_OPTIONS)


def test_low_speed_variance_is_found() -> None:
    rng = np.random.default_rng(0)
    dq = rng.uniform(-1, 1, (20_000, 2))
    variance = 0.04 + np.array([2.0, 0.0]) * np.exp(-((dq / 0.1) ** 2))
    noise, rest, slow = low_speed_variance(np.sqrt(variance) * rng.standard_normal(dq.shape), dq)
    np.testing.assert_allclose(noise, 0.04, rtol=0.05)
    assert rest[0] == pytest.approx(2.0, rel=0.1)
    assert slow[0] == 0.1
    assert rest[1] == 0.0


def test_residuals_of_any_size_are_accepted() -> None:
    dq = np.random.default_rng(0).uniform(-1, 1, (100, 1))
    for size in (0.0, 1e-150, 1e150):
        noise, rest, _ = low_speed_variance(np.full((100, 1), size), dq)
        assert np.isfinite([noise, rest]).all()


def at_rest(misfit: Misfit, dq: Array) -> Array:
    return misfit.at_rest(Motion(np.zeros_like(dq), dq, np.zeros_like(dq)))


def test_friction_at_standstill_is_unknown_at_standstill_alone() -> None:
    given = replace(Misfit.none(3), rest=np.array([0.0, 0.01, 4.0]), slow=np.array([0.02, 0.2, 0.2]))
    raised, still, moving = given.with_friction(np.full(3, 2.0)), np.zeros((1, 3)), np.full((1, 3), 0.2)
    np.testing.assert_allclose(at_rest(raised, still), [[2.0, 2.0, 4.0]])
    np.testing.assert_allclose(at_rest(raised, moving), at_rest(given, moving), atol=1e-12)
    slipping = replace(given, elements=np.full((2, 5, 3), 0.6)).with_friction(np.full(3, 2.0))
    np.testing.assert_allclose(slipping.still, [2.9, 2.89, 0.0])


@pytest.mark.parametrize("seconds", [0.0, 0.5])
def test_lasting_residuals_are_not_white_noise(seconds: float) -> None:
    """At 50 Hz, white noise is new in every row; low-passed noise lasts."""
    rng = np.random.default_rng(1)
    residual = rng.standard_normal((5000, 1))
    if seconds:
        residual = np.convolve(residual[:, 0], np.hanning(round(50 * seconds)), "same")[:, None]
    dq = 1.0 + rng.uniform(0, 1, residual.shape)
    moved = np.stack([dq, 3 * dq])
    misfit, noise = estimate_misfit(residual, residual, moved, [slice(0, 2500), slice(2500, 5000)])
    assert misfit.lasting / noise == pytest.approx(1.0 if seconds else 0.0, abs=0.05)
    usual = np.sqrt(np.mean(dq**2, axis=0))
    np.testing.assert_allclose((misfit.speed, misfit.acceleration), (usual, 3 * usual))


def test_rows_of_one_second_share_lasting_errors() -> None:
    samples = simulate_dirty(1)
    assert shared_rows(samples, TYPES, 200) == pytest.approx(10.0, rel=0.05)  # of twenty seconds
    assert shared_rows(samples, TYPES, 5) == 1.0
    again = Samples.concatenate([samples, samples, samples])  # the same motion, and so the same error, three times
    assert shared_rows(again, TYPES, 600) == pytest.approx(30.0, rel=0.05)
    one, rows = np.ones(2), INDEPENDENT_HZ * OPTIONS.lasting_s
    zero, moving = np.zeros((1, 2)), np.array([[0.0, 3.0]])
    counted = Misfit(0.5 * one, one, np.array([0.25, 1.0]), one, one, 0 * one).of_row(one, Motion(zero, moving, zero))
    expected = [0.75 + rows * (0.25 + 0.5), rows * (1.0 + 0.5 * np.exp(-9.0))]
    np.testing.assert_allclose(counted, np.array([expected]))


def test_predictions_include_the_misfit(model: TorqueModel) -> None:
    """Compare with the formula at rest and at new speeds, and the compiled prediction with the plain one."""
    posterior, misfit = model.posterior, model.posterior.misfit
    assert misfit.is_nonzero
    dq = np.array([[0.0, 0.0], [0.01, -0.02], [9.0, -7.0], [2.0, 9.0]])
    ddq = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.0], [-50.0, 90.0]])
    motion = Motion(np.full((4, 2), 0.3), dq, ddq)
    bare = replace(model, posterior=replace(posterior, misfit=Misfit.none(2)))
    found, without = (each.predict(motion.q, dq, ddq, covariance=True) for each in (model, bare))
    rest, slow, lasting, speed, acceleration, stuck = misfit.packed()[:MISFIT_ROWS]
    faster, harder = (np.maximum(np.mean((x / u) ** 2, axis=1) - 1, 0.0) for x, u in ((dq, speed), (ddq, acceleration)))
    faster += ACCELERATED * harder
    expected = rest * np.exp(-((dq / slow) ** 2)) + stuck * np.exp(-((dq / 0.02) ** 2)) + lasting * faster[:, None]
    if (torque := misfit.elements[0]).size:
        spread = deflections_at(dq, ddq, misfit.elements[1], acceleration)[:, len(torque) :]
        expected += np.square((torque * spread).sum(axis=1))
    np.testing.assert_allclose(found.tau_std**2 - without.tau_std**2, expected, rtol=1e-6, atol=1e-9 * expected.max())
    np.testing.assert_allclose(found.covariance, posterior.predict(motion).covariance, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(model.answer(motion.arrays()[3])[1], found.tau_std[3], rtol=1e-9)


def test_friction_at_rest_may_hold_any_torque(model: TorqueModel) -> None:
    coulomb = friction_coefficients(model.posterior, model.estimator).coulomb
    stated = at_rest(model.posterior.misfit, np.zeros((1, 2)))
    assert (stated > 0.3 * coulomb**2).all()  # a third, if every torque from −coulomb to coulomb is equally likely
    held = simulate_dirty(7, course="rests", speed=0.5)
    answer = model.predict(held.q, held.dq, held.ddq)
    still = (np.abs(held.dq) < 0.01).all(axis=1)
    assert 100 < still.sum() < len(held)
    found = evaluate(held.tau[still], answer.tau[still], answer.tau_std[still], answer.noise_std)
    assert (found.coverage > 0.85).all(), found.coverage


def test_misfit_is_saved_and_loaded(model: TorqueModel, tmp_path: Path) -> None:
    save(model, tmp_path / "model")
    again = load(tmp_path / "model")
    assert np.array_equal(again.posterior.misfit.packed(), model.posterior.misfit.packed())
    assert again.conformal == model.conformal


def test_stretches_cover_a_long_recording() -> None:
    samples = Samples.concatenate([simulate_dirty(1), simulate_dirty(2, speed=50.0)])
    task = Task(samples, TYPES)
    assert task.contiguous(len(samples)) is samples
    part = task.contiguous(400)
    assert len(part) == 400
    speeds = (np.sqrt(np.mean(each.dq**2, axis=0)) for each in (part, samples))
    np.testing.assert_allclose(*speeds, rtol=0.2)
    assert {each.stop - each.start for each in part.episodes()} == {20}
    for each in part.episodes():
        np.testing.assert_allclose(np.diff(part.t[each]), 1 / STREAM.rate, rtol=1e-6)


def test_black_box_is_as_uncertain_at_rest_as_arm() -> None:
    samples = simulate_dirty(1)
    task = Task(samples, TYPES, QUICK_OPTIONS)
    robot = RigidBody.from_profile("double-pendulum", samples.joint_names, TYPES)
    arm = learn(task, begin=[Geometry.from_robot(robot)])
    louder = replace(arm, misfit=replace(arm.misfit, rest=4 * arm.misfit.rest))
    for name in ("lip-chain", "rigid-body+lip-chain"):
        misfit = fit_estimator(task, name, louder).posterior.misfit
        assert (misfit.rest >= louder.misfit.rest).all()
        taken = misfit.rest == louder.misfit.rest
        assert taken.any()
        assert np.array_equal(misfit.slow[taken], arm.misfit.slow[taken])

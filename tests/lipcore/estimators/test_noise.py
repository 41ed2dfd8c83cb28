"""Tests of the noise estimate, against priors with known noise and a brute-force search."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from scipy.optimize import minimize

from lipcore.data.motion import Array, Motion
from lipcore.estimators import noise
from lipcore.kernels.combined import SumKernel
from lipcore.kernels.drive.kernel import Drive, DriveKernel
from lipcore.posterior.exact import negative_log_evidence, noisy_gram
from tests.lipcore.data.test_metrics import recording
from tests.lipcore.oracles import random_problem

JOINTS = ("revolute", "prismatic", "revolute")
TRUE_STD = np.array([0.02, 0.3, 0.08])
NO_FLOOR = np.full((3,), -30.0)


class Draw(NamedTuple):
    """Torques drawn from a prior with noise TRUE."""

    kernel: SumKernel
    params: dict[str, Array]
    motion: Motion
    tau: Array

    def starting_at(self, std: np.ndarray) -> dict[str, Array]:
        """Return the true hyperparameters with another noise, (n,) N·m."""
        return {**self.params, "noise.log_std": np.log(std)}


def draw(samples: int, seed: int) -> Draw:
    problem = random_problem(JOINTS, samples, seed, "chain")
    both = SumKernel(problem.kernel, DriveKernel(Drive(3)))
    params = {**problem.params, "noise.log_std": np.log(TRUE_STD)}
    lower = np.linalg.cholesky(noisy_gram(both, params, problem.motion))
    white = np.random.default_rng(seed).standard_normal(3 * samples)
    return Draw(both, params, problem.motion, (lower @ white).reshape(samples, 3))


def refine_noise(
    case: Draw, begin: np.ndarray, centre: np.ndarray | None = None, floor: Array = NO_FLOOR
) -> np.ndarray:
    """Return the noise std (n,) after `refine` from `begin`; the prior is centred there by default."""
    params = case.starting_at(begin)
    middle = params["noise.log_std"] if centre is None else np.log(centre)
    out = noise.refine(case.kernel, params, case.motion, case.tau, middle, floor)
    assert out.keys() == params.keys()
    assert all(out[name] is params[name] for name in params if name != "noise.log_std")
    return np.exp(out["noise.log_std"])


@pytest.mark.each_once
@pytest.mark.parametrize("factor", [1 / 3, 1 / 2, 1.0, 2.0, 3.0])
@pytest.mark.parametrize("seed", [0, 2, 3])
def test_known_noise_is_recovered_from_a_wrong_start(seed: int, factor: float) -> None:
    assert np.allclose(refine_noise(draw(200, seed), factor * TRUE_STD), TRUE_STD, rtol=0.15)


def penalised_evidence(case: Draw, log_std: np.ndarray, centre: np.ndarray) -> float:
    """Return −log evidence − log prior of the noise, from the evidence that fits maximise."""
    evidence = negative_log_evidence(case.kernel, case.starting_at(np.exp(log_std)), case.motion, case.tau).value
    return evidence + 0.5 * float(np.sum((log_std - np.log(centre)) ** 2)) / noise.OPTIONS.prior_std**2


@pytest.mark.each_once
@pytest.mark.parametrize("factor", [0.5, 2.0])
@pytest.mark.parametrize("seed", [5, 6])
def test_first_step_reaches_the_brute_force_maximum(seed: int, factor: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(noise, "OPTIONS", replace(noise.OPTIONS, chance_ratio=np.inf))  # no second step
    case, centre = draw(12, seed), 2.5 * TRUE_STD
    options = {"xatol": 1e-7, "fatol": 1e-11, "maxiter": 4000, "maxfev": 4000}
    best = minimize(
        lambda x: penalised_evidence(case, x, centre), np.log(TRUE_STD), method="Nelder-Mead", options=options
    )
    begin = factor * np.exp(best.x)
    # the default threshold stops close to the maximum, where more steps gain little
    near = np.log(refine_noise(case, begin, centre))
    assert penalised_evidence(case, near, centre) < best.fun + 0.1
    monkeypatch.setattr(noise, "OPTIONS", replace(noise.OPTIONS, max_newton_steps=100, converged_step=1e-6))
    assert np.allclose(refine_noise(case, begin, centre), np.exp(best.x), rtol=1e-4)


@pytest.mark.parametrize("samples", [10, 24, 25, 26, 61])
def test_second_step_cross_validates_stretches(samples: int) -> None:
    """Compare with each stretch conditioned on the rest, also with fewer samples than stretches."""
    case = draw(samples, 4)
    gram = noisy_gram(case.kernel, case.params, case.motion)
    y = case.tau.ravel()
    ratios = []
    for rows in np.array_split(np.arange(samples), noise.OPTIONS.stretches):
        out = (3 * rows[:, None] + np.arange(3)).ravel()
        rest = np.setdiff1d(np.arange(3 * samples), out)
        gain = np.linalg.solve(gram[np.ix_(rest, rest)], gram[np.ix_(rest, out)]).T
        covariance = gram[np.ix_(out, out)] - gain @ gram[np.ix_(rest, out)]
        ratios.append(((y[out] - gain @ y[rest]) ** 2 / covariance.diagonal()).reshape(-1, 3))
    expected = np.concatenate(ratios).mean(0)
    dense = np.linalg.inv(gram)
    found = noise._cross_validate(dense, dense @ y, 3)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_lasting_noise_is_not_fitted_as_torque() -> None:
    """Filtered noise looks like torque along a recording until a stretch is left out."""
    rng, samples = np.random.default_rng(2), 250
    t = np.arange(samples)[:, None] / 20
    speeds = rng.uniform(0.5, 2.0, 3)
    q = np.sin(speeds * t)
    motion = Motion.from_arrays(q, speeds * np.cos(speeds * t), -(speeds**2) * q)
    case = draw(samples, 2)
    lower = np.linalg.cholesky(noisy_gram(case.kernel, case.starting_at(1e-4 * np.ones(3)), motion))
    clean = (lower @ rng.standard_normal(3 * samples)).reshape(samples, 3)
    white = rng.standard_normal((samples, 3))
    window = np.hanning(22)[1:-1] / np.linalg.norm(np.hanning(22)[1:-1])
    lasting = np.stack([np.convolve(column, window, mode="same") for column in white.T], axis=1)
    level = np.array([0.1, 0.3, 0.1])
    found = {}
    for name, error in (("white", white), ("lasting", lasting)):
        noisy = case._replace(motion=motion, tau=clean + level * error)
        found[name] = refine_noise(noisy, level) / level
    assert np.allclose(found["white"], 1.0, rtol=0.2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(noise, "OPTIONS", replace(noise.OPTIONS, chance_ratio=np.inf))
        first = refine_noise(noisy, level) / level
    assert (found["lasting"] >= first).all()
    assert found["lasting"].mean() > 1.2 * first.mean()


def test_noise_never_falls_below_its_floor() -> None:
    case = draw(60, 0)
    floor = np.log(np.array([2.0, 0.1, 1.0]) * TRUE_STD)
    for begin in (TRUE_STD, 3 * TRUE_STD, 0.01 * TRUE_STD):
        assert (refine_noise(case, begin, floor=floor) >= np.exp(floor) * (1 - 1e-12)).all()
    # the floor of the first joint lies above the noise of the data
    assert refine_noise(case, np.array([2.0, 1.0, 1.0]) * TRUE_STD, floor=floor)[0] == pytest.approx(
        2 * TRUE_STD[0], rel=1e-12
    )


def test_start_is_white_noise_or_hundredth_of_spread() -> None:
    t, rng = np.arange(500) / 100, np.random.default_rng(0)
    wave = 10 * np.sin(2 * np.pi * 0.5 * t)
    std = noise.start(recording(t, np.stack([wave, wave + 0.5 * rng.standard_normal(500)], axis=1)))
    assert std[0] == pytest.approx(0.01 * wave.std(), rel=1e-6)
    assert std[1] == pytest.approx(0.5, rel=0.15)

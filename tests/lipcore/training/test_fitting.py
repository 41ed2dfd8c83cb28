"""Tests of fitting: progress, cancellation, noise, options, devices and several starts."""

import re
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.optimize import minimize

from lipcore import FitCancelledError, FitOptions, FitProgress, NotPositiveDefiniteError, Samples, train
from lipcore.data.samples import Array
from lipcore.estimators import hyperparameters as fitting
from lipcore.estimators import options
from lipcore.estimators.catalogue import ESTIMATORS, make_estimator
from lipcore.estimators.hyperparameters import Fit, fit
from lipcore.posterior import exact as evidence
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from tests.choosing import slow

SMALL_OPTIONS = FitOptions(hyperparameter_samples=25, posterior_samples=60, max_iterations=12, starts=1, device="cpu")
TYPES = ("revolute",) * 2
GPU_ESTIMATORS = ("se", "gip", "lse")


def pendulum(noise: float = 0.01, n_samples: int = 80) -> Samples:
    return simulate(load_robot("double-pendulum"), Simulation(n_samples=n_samples, speed=10, noise=noise), seed=1)


def fit_pendulum(samples: Samples, estimator: str = "lip", on_progress=None, cancelled=None, **options) -> Fit:
    kernel = make_estimator(estimator, TYPES).kernel
    return fit(kernel, samples, replace(SMALL_OPTIONS, **options), on_progress, cancelled)


def test_progress_counts_iterations_and_ends_with_the_posterior() -> None:
    seen: list[FitProgress] = []
    report = fit_pendulum(pendulum(), on_progress=seen.append).report
    assert [p.stage for p in seen] == ["hyperparameters"] * (len(seen) - 1) + ["posterior"]
    assert [p.iteration for p in seen[:-1]] == list(range(1, len(seen)))
    assert len(seen) - 1 == report.iterations > 5
    assert all(p.max_iterations == 12 for p in seen)
    assert all(0 < p.fraction <= 1 for p in seen)
    # L-BFGS accepts no step that makes the objective worse
    for values in ([p.fraction for p in seen], [p.elapsed for p in seen], [-p.objective for p in seen]):
        assert values == sorted(values)
    assert seen[-1].objective == report.objective < seen[0].objective


@pytest.mark.parametrize("estimator", ["lip", "lip-chain"])
def test_gradient_includes_evidence_and_priors(estimator: str) -> None:
    samples = pendulum(n_samples=15)
    kernel, motion, tau = make_estimator(estimator, TYPES).kernel, samples.motion(), samples.tau
    start = kernel.initial(motion, tau) | {"noise.log_std": np.full((2,), -3.0)}
    objective = fitting._Search(kernel, start, np.full((2,), -20.0), motion, tau, lambda: False, "cpu")
    at = objective.pack(start) + np.random.default_rng(0).uniform(-1, 1, objective.pack(start).shape)
    gradient = objective(at)[1]
    for k in range(len(at)):
        step = 1e-4 * np.eye(len(at))[k]
        near, far = (objective(at + s * step)[0] - objective(at - s * step)[0] for s in (1, 2))
        assert gradient[k] == pytest.approx((8 * near - far) / 12e-4, rel=1e-6, abs=1e-5)


@pytest.mark.parametrize(("starts", "allowed"), [(1, 0), (1, 5), (6, 3)])
def test_cancellation_stops_before_the_next_evaluation(starts, allowed, monkeypatch) -> None:
    evaluations = Mock(wraps=evidence.negative_log_evidence)
    monkeypatch.setattr(fitting, "negative_log_evidence", evaluations)
    with pytest.raises(FitCancelledError):
        fit_pendulum(pendulum(), cancelled=lambda: evaluations.call_count >= allowed, starts=starts)
    assert evaluations.call_count == allowed


def test_noise_stays_above_its_floor() -> None:
    samples = pendulum(noise=0.0)
    noise = np.exp(fit_pendulum(samples, max_iterations=60).params["noise.log_std"])
    spread = samples.tau.std(0)
    floor = np.maximum(1e-4 * spread, 1e-5 * spread.max())
    assert (noise >= floor * (1 - 1e-9)).all()
    assert (noise < 20 * floor).all()


@pytest.mark.parametrize(("robot", "viscous"), [("double-pendulum", 0.0), slow("ur5", 0.1)])
def test_noise_is_recovered(robot: str, viscous: float) -> None:
    arm = load_robot(robot)
    samples = simulate(arm, Simulation(n_samples=200, speed=10, noise=0.05, viscous=viscous), seed=1)
    options = FitOptions(hyperparameter_samples=70, max_iterations=50, device="cpu")
    noise = np.exp(fit(make_estimator("lip", arm.joint_types).kernel, samples, options).params["noise.log_std"])
    assert np.allclose(noise, 0.05, rtol=0.3)


def test_line_search_survives_a_singular_covariance(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[FitProgress] = []
    staged = iter([NotPositiveDefiniteError("staged")])

    def fails_once(*arguments):
        if len(seen) == 2:  # the third iteration of the search tries a step
            for error in staged:
                raise error
        return evidence.negative_log_evidence(*arguments)

    monkeypatch.setattr(fitting, "negative_log_evidence", fails_once)
    report = fit_pendulum(pendulum(), on_progress=seen.append).report
    assert next(staged, None) is None
    assert report.rejected_steps == 1
    assert report.objective < seen[0].objective


@pytest.mark.parametrize("starts", [1, 3])
def test_singular_start_is_an_error(starts: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fitting, "negative_log_evidence", Mock(side_effect=NotPositiveDefiniteError("staged")))
    with pytest.raises(NotPositiveDefiniteError, match="staged"):
        fit_pendulum(pendulum(), starts=starts)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("hyperparameter_samples", 9),
        ("hyperparameter_samples", 50.0),
        ("posterior_samples", 5001),
        ("max_iterations", "many"),
        ("starts", 0),
        ("device", "tpu"),
        ("statistics", "some"),
    ],
)
def test_invalid_option_is_named(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=f"^{name} is {value!r}, expected"):
        FitOptions(**{name: value})


def test_only_uncompiled_estimators_use_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    for gpu in (True, False):
        monkeypatch.setattr(options, "_cuda", lambda gpu=gpu: gpu)
        for name in ("auto", *ESTIMATORS):
            found = FitOptions(device="auto").place(name)
            assert found == ("cuda" if gpu and name in GPU_ESTIMATORS else "cpu"), name
            assert FitOptions(device="cpu").place(name) == "cpu"
    for name in ("auto", *ESTIMATORS):
        compiled = f"'{re.escape(name)}' is faster on the CPU: leave `device` out"
        message = "device is 'cuda', but torch sees no CUDA device" if name in GPU_ESTIMATORS else compiled
        with pytest.raises(ValueError, match=message):
            train(pendulum(), TYPES, name, replace(SMALL_OPTIONS, device="cuda"))


@pytest.mark.skipif(FitOptions(device="auto").place("se") == "cpu", reason="no CUDA device on this machine")
@pytest.mark.parametrize("estimator", GPU_ESTIMATORS)
def test_cuda_fit_matches_the_cpu(estimator: str) -> None:
    arm = load_robot("tiago")
    samples = simulate(arm, Simulation(n_samples=80, speed=10, noise=0.05), seed=1)
    unseen = simulate(arm, Simulation(n_samples=50, speed=10, noise=0.0), seed=101)
    # few iterations, as L-BFGS amplifies rounding with every step
    options = replace(SMALL_OPTIONS, max_iterations=5)
    cpu, cuda = (train(samples, arm.joint_types, estimator, replace(options, device=d)) for d in ("cpu", "cuda"))
    assert cuda.fit["device"] == "cuda"
    assert cuda.fit["objective"] == pytest.approx(cpu.fit["objective"], rel=1e-6)
    found, expected = (each.predict(unseen.q, unseen.dq, unseen.ddq) for each in (cuda, cpu))
    assert (np.abs(found.tau - expected.tau) < 1e-4 * unseen.tau.std(0)).all()
    assert np.allclose(found.tau_std, expected.tau_std, rtol=1e-3)


class ManyValleys(fitting._Search):
    """A search in one dimension over many valleys; `barred` starts cannot be factored."""

    def __init__(self, barred: tuple[int, ...] = ()) -> None:
        self.start = {"x": np.array([3.0])}
        self.widths = {"x": 20.0}
        self.barred, self.begun, self.best = barred, [], np.inf

    @staticmethod
    def height(x: np.ndarray) -> float:
        return float(np.sum(0.05 * x**2 + 2 * np.cos(3 * x)))

    def run(self, begin: np.ndarray, iterations: int, callback: object = None) -> SimpleNamespace:
        self.begun.append(begin)
        if len(self.begun) - 1 in self.barred:
            raise NotPositiveDefiniteError("barred")
        return minimize(self.height, begin, method="L-BFGS-B", options={"maxiter": iterations})


@pytest.mark.parametrize("barred", [(), (0,), (1, 3)], ids=str)
def test_lowest_valley_is_chosen_and_failed_starts_skipped(barred: tuple[int, ...]) -> None:
    hills = ManyValleys(barred)
    chosen, origin = fitting._best_start(hills, 6)
    assert len(hills.begun) == 6
    assert hills.begun[0].tolist() == [3.0]  # the kernel's own start is always among them
    assert len({float(begin[0]) for begin in hills.begun}) == 6
    reached = {
        number: minimize(ManyValleys.height, begin, method="L-BFGS-B").fun
        for number, begin in enumerate(hills.begun)
        if number not in barred
    }
    assert chosen == min(reached, key=reached.__getitem__)
    assert ManyValleys.height(origin) == pytest.approx(reached[chosen], abs=1e-6)


def test_noise_of_a_random_start_stays_above_its_floor(monkeypatch: pytest.MonkeyPatch) -> None:
    seen, samples = [], pendulum()

    def watched(kernel: object, params: dict[str, Array], *data: object):
        seen.append(params["noise.log_std"].copy())
        return evidence.negative_log_evidence(kernel, params, *data)

    monkeypatch.setattr(fitting, "negative_log_evidence", watched)
    monkeypatch.setattr(fitting, "START_SPREAD", 5.0)
    still = replace(samples, tau=1e-3 * np.sin(samples.q))
    assert fit_pendulum(still, "lip-chain", starts=5, max_iterations=2).report.start in range(5)
    spread = still.tau.std(0)
    floor = np.log(np.maximum(1e-4 * spread, 1e-5 * np.sqrt((still.tau**2).mean(0)).max()))
    assert np.min(np.array(seen) - floor) >= -1e-9
    assert (np.array(seen) <= floor + 1e-9).all(axis=1).any()

"""Several starts of a fit: the best of them is followed, those that cannot be followed are left out."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch import Tensor

from lipcore.data.motion import Motion
from lipcore.data.samples import Samples
from lipcore.fitting import hyperparameters as fitting
from lipcore.fitting.estimators import make_estimator
from lipcore.fitting.hyperparameters import fit
from lipcore.fitting.options import FitOptions
from lipcore.kernels.base import SumKernel
from lipcore.kernels.chain import ChainKernel
from lipcore.kernels.friction import FrictionKernel
from lipcore.posterior.linalg import NotPositiveDefiniteError
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Stream, simulate

OPTIONS = FitOptions(hyperparameter_samples=40, posterior_samples=60, max_iterations=20, device="cpu")


class Hills(fitting._Search):
    """A search in one dimension over an objective with many valleys; `barred` starts cannot be factored."""

    def __init__(self, barred: tuple[int, ...] = ()) -> None:
        self.start = {"x": torch.tensor([3.0], dtype=torch.float64)}
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
def test_the_lowest_valley_is_chosen_and_starts_that_fail_are_left_out(barred: tuple[int, ...]) -> None:
    hills = Hills(barred)
    chosen, origin = fitting._best_start(hills, 6)
    assert len(hills.begun) == 6
    assert hills.begun[0].tolist() == [3.0]  # the kernel's own start is always among them
    assert len({float(begin[0]) for begin in hills.begun}) == 6
    reached = {
        number: minimize(Hills.height, begin, method="L-BFGS-B").fun
        for number, begin in enumerate(hills.begun)
        if number not in barred
    }
    assert chosen == min(reached, key=reached.__getitem__)
    assert Hills.height(origin) == pytest.approx(reached[chosen], abs=1e-6)


class FarOff(ChainKernel):
    """The chain kernel, started where joints seem not to turn anything and inertia is a million times too large."""

    def initial(self, motion: Motion, tau: Tensor) -> dict[str, Tensor]:
        """Those of the chain kernel, moved away."""
        start = super().initial(motion, tau)
        start["kinetic.log_scale"] = start["kinetic.log_scale"] + 14.0
        start["chain.logits"] = torch.full_like(start["chain.logits"], -12.0)
        return start


@pytest.fixture(scope="module")
def samples() -> Samples:
    return simulate(load_robot("double-pendulum"), Stream(n_samples=80, speed=10, noise=0.01), seed=1)


def test_fit_from_several_starts_says_which_it_followed_and_repeats(samples: Samples) -> None:
    kernel = SumKernel(FarOff(("revolute",) * 2), FrictionKernel(2))
    one = fit(kernel, samples, replace(OPTIONS, starts=1)).report
    several = [fit(kernel, samples, replace(OPTIONS, starts=3)) for _ in range(2)]
    assert one.start == 0
    assert several[0].report.start in range(3)
    # even so bad a start of its own finds the only good optimum, and more starts lose nothing
    assert several[0].report.objective < one.objective + 0.1
    assert several[0].report.start == several[1].report.start
    for name, value in several[0].params.items():
        assert torch.equal(value, several[1].params[name]), name


def test_noise_of_a_drawn_start_keeps_above_its_floor(samples: Samples, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    evidence = fitting.negative_log_evidence

    def watched(kernel: object, params: dict[str, Tensor], *data: object):
        seen.append(params["noise.log_std"].clone())
        return evidence(kernel, params, *data)

    monkeypatch.setattr(fitting, "negative_log_evidence", watched)
    monkeypatch.setattr(fitting, "START_SPREAD", 5.0)
    still = replace(samples, tau=1e-3 * np.sin(samples.q))
    fit(make_estimator("lip-chain", ("revolute",) * 2).kernel, still, replace(OPTIONS, starts=5, max_iterations=2))
    spread = still.tau.std(0)
    floor = torch.from_numpy(np.log(np.maximum(1e-4 * spread, 1e-5 * np.sqrt((still.tau**2).mean(0)).max())))
    assert all((noise >= floor - 1e-9).all() for noise in seen)
    assert any((noise <= floor + 1e-9).any() for noise in seen)

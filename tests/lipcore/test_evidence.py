"""Evidence: its value against SciPy's density, its gradient against finite differences of that density."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from lipcore.kernels.base import Params, SumKernel, TorqueKernel
from lipcore.kernels.friction import FrictionKernel
from lipcore.posterior.exact import negative_log_evidence
from lipcore.posterior.linalg import NotPositiveDefiniteError
from tests.lipcore.problems import KERNELS, Problem, TorchForm, random_problem

SAMPLES = 9
STEP = 1e-4


class Setting(NamedTuple):
    """Random torques of a random robot."""

    problem: Problem
    kernel: SumKernel
    tau: np.ndarray


@pytest.fixture(scope="module", params=KERNELS)
def setting(request: pytest.FixtureRequest) -> Setting:
    joints = ("revolute", "prismatic", "revolute")
    problem = random_problem(joints, SAMPLES, seed=7, kernel=request.param)
    tau = np.random.default_rng(8).normal(size=(SAMPLES, 3))
    return Setting(problem, SumKernel(problem.kernel, FrictionKernel(3)), tau)


def density(setting: Setting, params: Params) -> float:
    """−log p(tau) by SciPy from the plain Gram matrix."""
    motion = setting.problem.motion
    noise = np.exp(params["noise.log_std"].numpy())
    gram = setting.kernel.gram(params, motion, motion).numpy()
    covariance = 0.5 * (gram + gram.T) + np.diag(np.tile(noise**2, len(motion)))
    return -float(multivariate_normal.logpdf(setting.tau.ravel(), cov=covariance))


def evidence(setting: Setting):
    tau = torch.from_numpy(setting.tau)
    return negative_log_evidence(setting.kernel, setting.problem.params, setting.problem.motion, tau)


def test_value_is_the_gaussian_density(setting: Setting) -> None:
    assert evidence(setting).value == pytest.approx(density(setting, setting.problem.params), rel=1e-10)


@pytest.mark.parametrize("pairs", [None, 4096, 30], ids=["compiled", "one chunk", "many chunks"])
def test_gradient_equals_finite_differences_of_the_density(
    setting: Setting, pairs: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    energies: TorqueKernel = setting.problem.kernel
    if pairs is not None:
        # with many chunks the pairs below the diagonal blocks are only counted, not computed
        monkeypatch.setattr("lipcore.kernels.base.PAIRS_PER_CHUNK", pairs)
        energies = TorchForm(setting.problem.kernel)
    gradient = evidence(setting._replace(kernel=SumKernel(energies, FrictionKernel(3)))).gradient
    params = setting.problem.params
    assert gradient.keys() == params.keys()

    for name, value in params.items():
        expected = np.zeros(value.shape)
        for index in np.ndindex(*value.shape):

            def shifted(step: float, name: str = name, index: tuple[int, ...] = index) -> float:
                moved = {key: tensor.clone() for key, tensor in params.items()}
                moved[name][index] += step
                return density(setting, moved)

            # fourth order, so that the step may be long enough to drown rounding
            near, far = shifted(STEP) - shifted(-STEP), shifted(2 * STEP) - shifted(-2 * STEP)
            expected[index] = (8 * near - far) / (12 * STEP)
        assert np.abs(expected).max() > 1e-3, f"{name} does not matter here"
        assert np.allclose(gradient[name].numpy(), expected, rtol=1e-6, atol=1e-7), name


def test_covariance_that_cannot_be_factored_is_reported() -> None:
    problem = random_problem(("revolute",), samples=5, seed=0)
    params = problem.params | {"noise.log_std": torch.tensor([float("nan")]).double()}
    kernel = SumKernel(problem.kernel, FrictionKernel(1))
    with pytest.raises(NotPositiveDefiniteError):
        negative_log_evidence(kernel, params, problem.motion, torch.zeros(5, 1).double())

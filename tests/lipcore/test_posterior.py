"""Exact posterior and evidence against dense references that share nothing with them but the kernel of two samples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from lipcore.data.motion import Motion
from lipcore.kernels.base import Params, SumKernel, TorqueKernel
from lipcore.kernels.friction import FrictionKernel
from lipcore.posterior.exact import ExactPosterior, negative_log_evidence
from lipcore.posterior.linalg import NotPositiveDefiniteError
from tests.lipcore.problems import KERNELS, Problem, TorchForm, random_problem

JOINTS = ("revolute", "prismatic", "revolute")
N_JOINTS = len(JOINTS)
STEP = 1e-4


class Setting(NamedTuple):
    """A posterior on random torques, and queries it has not seen."""

    problem: Problem
    kernel: SumKernel
    tau: torch.Tensor
    query: Motion
    posterior: ExactPosterior


@pytest.fixture(scope="module", params=KERNELS)
def setting(request: pytest.FixtureRequest) -> Setting:
    problem = random_problem(JOINTS, samples=9, seed=4, kernel=request.param)
    kernel = SumKernel(problem.kernel, FrictionKernel(N_JOINTS))
    tau = torch.from_numpy(np.random.default_rng(5).normal(size=(9, N_JOINTS)))
    query = random_problem(JOINTS, samples=7, seed=6).motion
    return Setting(problem, kernel, tau, query, ExactPosterior.fit(kernel, problem.params, problem.motion, tau))


def covariance(setting: Setting, x: Motion, y: Motion) -> np.ndarray:
    """k(x, y) from one pair of samples at a time, (N n, M n)."""
    rows = []
    for i in range(len(x)):
        row = [setting.kernel.gram(setting.problem.params, x[i : i + 1], y[j : j + 1]).numpy() for j in range(len(y))]
        rows.append(np.hstack(row))
    return np.vstack(rows)


def test_mean_and_covariance_equal_the_dense_reference(setting: Setting) -> None:
    training = setting.problem.motion
    noise = np.exp(setting.problem.params["noise.log_std"].numpy())
    dense = covariance(setting, training, training) + np.diag(np.tile(noise**2, len(training)))
    cross = covariance(setting, setting.query, training)
    mean = cross @ np.linalg.solve(dense, setting.tau.numpy().ravel())
    total = covariance(setting, setting.query, setting.query) - cross @ np.linalg.solve(dense, cross.T)

    answer = setting.posterior.predict(setting.query)
    size = np.abs(covariance(setting, setting.query, setting.query)).max()
    assert np.allclose(answer.mean.numpy().ravel(), mean, rtol=0, atol=1e-9 * np.abs(mean).max())
    assert np.allclose(setting.posterior.mean(setting.query), answer.mean, rtol=0, atol=1e-9 * np.abs(mean).max())
    for k in range(len(setting.query)):
        part = slice(N_JOINTS * k, N_JOINTS * (k + 1))
        assert np.allclose(answer.covariance[k].numpy(), total[part, part], rtol=0, atol=1e-10 * size)
    assert np.allclose(answer.std.numpy().ravel() ** 2, np.diag(total), rtol=0, atol=1e-10 * size)


def test_covariance_is_symmetric_positive_semidefinite_and_below_the_prior(setting: Setting) -> None:
    prior = setting.kernel.variance(setting.problem.params, setting.query)
    answer = setting.posterior.predict(setting.query).covariance
    size = prior.abs().amax((1, 2))
    assert ((answer - answer.mT).abs().amax((1, 2)) <= 1e-12 * size).all()
    assert (torch.linalg.eigvalsh(answer)[:, 0] >= -1e-10 * size).all()
    # not only each variance: every combination of torques is known at least as well as before
    assert (torch.linalg.eigvalsh(prior - answer)[:, 0] >= -1e-10 * size).all()
    assert (answer.diagonal(dim1=1, dim2=2) <= prior.diagonal(dim1=1, dim2=2)).all()


def test_terms_of_the_kernel_share_out_the_mean(setting: Setting) -> None:
    shares = [setting.posterior.mean(setting.query, term) for term in setting.kernel.terms]
    total = setting.posterior.mean(setting.query)
    assert all(share.abs().max() > 1e-3 * total.abs().max() for share in shares)
    assert torch.allclose(sum(shares), total, rtol=0, atol=1e-11 * float(total.abs().max()))


def density(setting: Setting, params: Params) -> float:
    """−log p(tau) by SciPy from the plain Gram matrix."""
    motion = setting.problem.motion
    noise = np.exp(params["noise.log_std"].numpy())
    gram = setting.kernel.gram(params, motion, motion).numpy()
    covariance = 0.5 * (gram + gram.T) + np.diag(np.tile(noise**2, len(motion)))
    return -float(multivariate_normal.logpdf(setting.tau.numpy().ravel(), cov=covariance))


def evidence(setting: Setting):
    return negative_log_evidence(setting.kernel, setting.problem.params, setting.problem.motion, setting.tau)


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

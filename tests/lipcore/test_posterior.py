"""The exact posterior against a dense reference that shares nothing with it but the kernel of two samples."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest
import torch

from lipcore.data.motion import Motion
from lipcore.kernels.base import SumKernel
from lipcore.kernels.friction import FrictionKernel
from lipcore.posterior.exact import ExactPosterior, noisy_gram
from tests.lipcore.problems import KERNELS, Problem, random_problem

JOINTS = ("revolute", "prismatic", "revolute")
N_JOINTS = len(JOINTS)


class Setting(NamedTuple):
    """A posterior on random torques, and queries it has not seen."""

    problem: Problem
    kernel: SumKernel
    tau: torch.Tensor
    query: Motion
    posterior: ExactPosterior


@pytest.fixture(scope="module", params=KERNELS)
def setting(request: pytest.FixtureRequest) -> Setting:
    problem = random_problem(JOINTS, samples=12, seed=4, kernel=request.param)
    kernel = SumKernel(problem.kernel, FrictionKernel(N_JOINTS))
    tau = torch.from_numpy(np.random.default_rng(5).normal(size=(12, N_JOINTS)))
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


def test_std_shrinks_when_data_are_added(setting: Setting) -> None:
    stds = []
    for count in (2, 5, 12):
        motion, tau = setting.problem.motion[:count], setting.tau[:count]
        part = ExactPosterior.fit(setting.kernel, setting.problem.params, motion, tau)
        stds.append(part.predict(setting.query).std)
    for fewer, more in pairwise(stds):
        assert (more <= fewer * (1 + 1e-9)).all()
        assert more.mean() < 0.99 * fewer.mean()


def test_terms_of_the_kernel_share_out_the_mean(setting: Setting) -> None:
    shares = [setting.posterior.mean(setting.query, term) for term in setting.kernel.terms]
    total = setting.posterior.mean(setting.query)
    assert all(share.abs().max() > 1e-3 * total.abs().max() for share in shares)
    assert torch.allclose(sum(shares), total, rtol=0, atol=1e-11 * float(total.abs().max()))


def test_predictions_do_not_depend_on_the_chunk_size(setting: Setting, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = setting.posterior.predict(setting.query)
    monkeypatch.setattr("lipcore.posterior.exact.QUERIES_PER_CHUNK", 3)
    parts = setting.posterior.predict(setting.query)
    assert torch.allclose(parts.mean, whole.mean, rtol=1e-10, atol=1e-12)
    assert torch.allclose(parts.covariance, whole.covariance, rtol=1e-9, atol=1e-11)


def test_noise_is_added_per_joint_on_the_diagonal_only(setting: Setting) -> None:
    params, motion = setting.problem.params, setting.problem.motion
    added = noisy_gram(setting.kernel, params, motion) - setting.kernel.symmetric_gram(params, motion)
    expected = torch.diag(torch.exp(2 * params["noise.log_std"]).repeat(len(motion)))
    assert torch.allclose(added, expected, rtol=0, atol=1e-12)

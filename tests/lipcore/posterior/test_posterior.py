"""Tests of the exact posterior and evidence against dense references, and of the compact posterior."""

from dataclasses import replace
from decimal import Decimal, localcontext
from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from lipcore import FitOptions, NotPositiveDefiniteError, Samples, TorqueModel, load
from lipcore.data.motion import Array, Motion
from lipcore.estimators.catalogue import ESTIMATORS, make_estimator
from lipcore.kernels.base import Params, TorqueKernel
from lipcore.kernels.combined import SumKernel
from lipcore.kernels.drive.kernel import Drive, DriveKernel
from lipcore.model import dynamics
from lipcore.model.parameters import weight_posterior
from lipcore.posterior.basis import Basis
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.compression import Deviation, compress
from lipcore.posterior.exact import ExactPosterior, negative_log_evidence
from lipcore.posterior.statistics import collect
from lipcore.vocabulary import offered_components
from tests import ROOT
from tests.lipcore.estimators.test_estimators import train_estimator
from tests.lipcore.online.test_learner import simulate_pendulum
from tests.lipcore.oracles import KERNELS, Problem, TorchForm, random_problem, with_full_counts

PANDA = ROOT / "models/panda-sim"
JOINTS = ("revolute", "prismatic", "revolute")
N_JOINTS = len(JOINTS)
STEP = 1e-4


class Setting(NamedTuple):
    """A posterior of random torques, and queries that it has not seen."""

    problem: Problem
    kernel: SumKernel
    tau: Array
    query: Motion
    posterior: ExactPosterior


@pytest.fixture(scope="module", params=KERNELS)
def setting(request: pytest.FixtureRequest) -> Setting:
    problem = random_problem(JOINTS, samples=9, seed=4, kernel=request.param)
    kernel = SumKernel(problem.kernel, DriveKernel(Drive(N_JOINTS)))
    tau = np.random.default_rng(5).normal(size=(9, N_JOINTS))
    query = random_problem(JOINTS, samples=7, seed=6).motion
    return Setting(problem, kernel, tau, query, ExactPosterior.fit(kernel, problem.params, problem.motion, tau))


def covariance(setting: Setting, x: Motion, y: Motion) -> np.ndarray:
    """Return k(x, y), one pair of samples at a time, (N n, M n)."""
    gram, params = setting.kernel.gram, setting.problem.params
    return np.block([[gram(params, x[i : i + 1], y[j : j + 1]) for j in range(len(y))] for i in range(len(x))])


def test_mean_and_covariance_match_the_dense_reference(setting: Setting) -> None:
    training, query = setting.problem.motion, setting.query
    noise = np.exp(setting.problem.params["noise.log_std"])
    dense = covariance(setting, training, training) + np.diag(np.tile(noise**2, len(training)))
    cross, prior = covariance(setting, query, training), covariance(setting, query, query)
    mean = (cross @ np.linalg.solve(dense, setting.tau.ravel())).reshape(-1, N_JOINTS)
    total = prior - cross @ np.linalg.solve(dense, cross.T)

    answer, size = setting.posterior.predict(query), np.abs(prior).max()
    for found in (answer.mean, setting.posterior.mean(query)):
        assert np.allclose(found, mean, rtol=0, atol=1e-9 * np.abs(mean).max())
    for k, found in enumerate(answer.covariance):
        part = slice(N_JOINTS * k, N_JOINTS * (k + 1))
        assert np.allclose(found, total[part, part], rtol=0, atol=1e-10 * size)
    assert np.allclose(answer.std.ravel() ** 2, np.diag(total), rtol=0, atol=1e-10 * size)


def test_covariance_is_positive_semidefinite_and_below_the_prior(setting: Setting) -> None:
    prior = setting.kernel.variance(setting.problem.params, setting.query)
    answer = setting.posterior.predict(setting.query).covariance
    size = np.abs(prior).max((1, 2))
    assert (np.abs(answer - answer.mT).max((1, 2)) <= 1e-12 * size).all()
    assert (np.linalg.eigvalsh(answer)[:, 0] >= -1e-10 * size).all()
    # not only variances: every combination of torques is at least as certain as before
    assert (np.linalg.eigvalsh(prior - answer)[:, 0] >= -1e-10 * size).all()
    assert (answer.diagonal(axis1=1, axis2=2) <= prior.diagonal(axis1=1, axis2=2)).all()


def test_terms_sum_to_the_mean(setting: Setting) -> None:
    shares = [setting.posterior.mean(setting.query, term) for term in setting.kernel.terms]
    total = setting.posterior.mean(setting.query)
    assert all(np.abs(share).max() > 1e-3 * np.abs(total).max() for share in shares)
    assert np.allclose(sum(shares), total, rtol=0, atol=1e-11 * float(np.abs(total).max()))


def density(setting: Setting, params: Params) -> float:
    """Return −log p(tau) by SciPy from the plain Gram matrix."""
    motion = setting.problem.motion
    noise = np.exp(params["noise.log_std"])
    gram = setting.kernel.gram(params, motion, motion)
    covariance = 0.5 * (gram + gram.T) + np.diag(np.tile(noise**2, len(motion)))
    return -float(multivariate_normal.logpdf(setting.tau.ravel(), cov=covariance))


def evidence(setting: Setting):
    return negative_log_evidence(setting.kernel, setting.problem.params, setting.problem.motion, setting.tau)


def test_value_is_the_gaussian_density(setting: Setting) -> None:
    assert evidence(setting).value == pytest.approx(density(setting, setting.problem.params), rel=1e-10)


@pytest.mark.parametrize("pairs", [None, 4096, 30], ids=["compiled", "one chunk", "many chunks"])
def test_gradient_matches_finite_differences(setting, pairs, monkeypatch) -> None:
    energies: TorqueKernel = setting.problem.kernel
    if pairs is not None:
        # with many chunks the pairs below the diagonal blocks are only counted, not computed
        monkeypatch.setattr("lipcore.kernels.base.PAIRS_PER_CHUNK", pairs)
        energies = TorchForm(setting.problem.kernel)
    gradient = evidence(setting._replace(kernel=SumKernel(energies, DriveKernel(Drive(3))))).gradient
    params = setting.problem.params
    assert gradient.keys() == params.keys()

    for name, value in params.items():
        expected = np.zeros(value.shape)
        for index in np.ndindex(*value.shape):

            def shifted(step: float, name: str = name, index: tuple[int, ...] = index) -> float:
                moved = {key: tensor.copy() for key, tensor in params.items()}
                moved[name][index] += step
                return density(setting, moved)

            # fourth order, so that the step may be long enough to suppress rounding
            near, far = shifted(STEP) - shifted(-STEP), shifted(2 * STEP) - shifted(-2 * STEP)
            expected[index] = (8 * near - far) / (12 * STEP)
        assert np.abs(expected).max() > 1e-3, f"{name} does not matter here"
        assert np.allclose(gradient[name], expected, rtol=1e-6, atol=1e-7), name


def test_singular_covariance_is_reported(setting: Setting) -> None:
    params = setting.problem.params | {"noise.log_std": np.full(N_JOINTS, np.nan)}
    with pytest.raises(NotPositiveDefiniteError):
        negative_log_evidence(setting.kernel, params, setting.problem.motion, setting.tau)


OPTIONS = FitOptions(hyperparameter_samples=40, max_iterations=40, starts=1, device="cpu")


class Case(NamedTuple):
    """A model, the exact posterior of the same samples, and unseen motions."""

    model: TorqueModel
    exact: ExactPosterior
    samples: Samples
    unseen: Motion


def fit_case(name: str) -> Case:
    samples = simulate_pendulum(1, coulomb=0.05)
    model = with_full_counts(train_estimator(name, samples, OPTIONS), samples)
    posterior = model.posterior
    exact = ExactPosterior.fit(posterior.kernel, posterior.params, samples.motion(), samples.tau, posterior.std_factor)
    return Case(model, exact, samples, simulate_pendulum(2, coulomb=0.05, n_sinusoids=100).motion())


@pytest.fixture(scope="module", params=ESTIMATORS)
def case(request: pytest.FixtureRequest) -> Case:
    return fit_case(request.param)


@pytest.fixture(scope="module")
def chain() -> Case:
    return fit_case("lip-chain")


def deviation(case: Case, posterior: CompactPosterior) -> float:
    """Return the largest deviation of means and standard deviations from the exact posterior's."""
    expected, answer = case.exact.predict(case.unseen), posterior.predict(case.unseen)
    found = Deviation.between(expected, answer.mean, answer.std, np.sqrt(posterior.noise_variance))
    return max(found.mean_max, found.std_max)


def test_compact_posterior_keeps_its_tolerance_on_unseen_motion(case: Case) -> None:
    report = case.model.compact
    assert report["tolerance_reached"] is True
    assert max(report["mean_max"], report["std_max"]) <= report["tolerance"] == 0.01
    assert deviation(case, case.model.posterior) < 0.02


def test_all_outputs_give_the_exact_posterior(case: Case) -> None:
    exact, noise = case.exact, np.exp(2 * case.exact.params["noise.log_std"])
    count = len(exact.weights) if case.model.posterior.basis.term is not None else 0
    basis = Basis.build(exact.kernel, exact.params, exact.motion, np.arange(count))
    statistics = collect(basis, noise, exact.motion, case.samples.tau - exact.kernel.mean(exact.motion))
    found = CompactPosterior.build(exact.kernel, basis, statistics, noise, exact.std_factor)
    assert deviation(case, found) < 1e-3


def test_components_match_the_exact_posterior(case: Case) -> None:
    names = [name for name in offered_components(case.model.estimator.name) if name != "forward_dynamics"]
    expected = dynamics.components(replace(case.model, posterior=case.exact), case.unseen[:20], names)
    answer = dynamics.components(case.model, case.unseen[:20], names)
    for name in names:
        unit = expected[name].std.clip(1e-3 * float(expected[name].std.max()))
        assert np.abs((answer[name].mean - expected[name].mean) / unit).max() < 0.1, name
        assert np.abs((answer[name].std - expected[name].std) / unit).max() < 0.05, name


def test_linear_weights_match_the_exact_posterior(case: Case) -> None:
    for term in case.model.posterior.basis.linear:
        expected, answer = (weight_posterior(each, term) for each in (case.exact, case.model.posterior))
        assert (np.abs(answer.mean - expected.mean) < 0.1 * expected.std).all()
        np.testing.assert_allclose(answer.std, expected.std, rtol=0.05)


def test_too_few_outputs_widen_the_interval(chain: Case) -> None:
    """With a quarter of the outputs, the intervals are wider and still contain the exact mean."""
    enough = chain.model.compact["inducing_outputs"]
    found = compress(chain.exact, chain.samples.tau, 0.02, enough // 4)
    assert not found.reached
    assert len(found.posterior.basis.outputs) == enough // 4
    assert max(found.deviation.mean_max, found.deviation.std_max) > 0.02
    expected, answer = chain.exact.predict(chain.unseen), found.posterior.predict(chain.unseen)
    assert (answer.std > 0.95 * expected.std).all()
    assert (np.abs(answer.mean - expected.mean) < 4 * answer.std).mean() > 0.98


def test_size_does_not_grow_with_samples(chain: Case) -> None:
    """Four times the samples of the same motion need hardly more outputs."""
    sizes = []
    for count in (1, 4):
        samples = simulate_pendulum(1, coulomb=0.05, n_samples=120 * count, rate=10.0 * count)
        exact = ExactPosterior.fit(chain.exact.kernel, chain.exact.params, samples.motion(), samples.tau)
        sizes.append(len(compress(exact, samples.tau, 0.02, 1500).posterior.basis))
    assert sizes[1] < 1.25 * sizes[0]


def test_small_standard_deviation_keeps_its_digits() -> None:
    """Compute |L⁻¹ φ|, I + A = L Lᵀ, of the shipped Panda's statistics with fifty digits.

    The posterior variance is 1e-8 of the prior's; as a difference it would lose eight digits.
    """
    model = load(PANDA)
    posterior, count = model.posterior, 5
    draw, limits = np.random.default_rng(3).uniform, model.training_range
    motion = Motion(*(draw(limits[name]["min"], limits[name]["max"], (count, 7)) for name in ("q", "dq", "ddq")))
    with localcontext(prec=50):
        exact = np.frompyfunc(Decimal, 1, 1)
        total = exact(posterior.statistics.a) + exact(np.eye(len(posterior.basis)))
        rows = exact(posterior.basis.features(motion))
        before = (rows * rows).sum(0)
        for k in range(len(total)):  # elimination, column by column, of the matrix and the features at once
            factor = total[k + 1 :, k] / total[k, k]
            total[k + 1 :] -= factor[:, None] * total[k]
            rows[k + 1 :] -= factor[:, None] * rows[k]
        left = (rows * rows / np.diagonal(total)[:, None]).sum(0)
        shares = (left / before).astype(float)
    assert np.median(shares) < 1e-7
    variance = posterior.std_factor**2 * left.astype(float).reshape(count, 7) + posterior.misfit.variance(motion)
    answer = model.predict(motion.q, motion.dq, motion.ddq)
    np.testing.assert_allclose(answer.tau_std, np.sqrt(variance), rtol=1e-8)


def test_indefinite_statistics_are_rejected(chain: Case) -> None:
    posterior = chain.model.posterior
    broken = replace(posterior.statistics, a=posterior.statistics.a - 10 * np.eye(len(posterior.basis)))
    with pytest.raises(NotPositiveDefiniteError, match=r"statistics of size .* have the eigenvalue -"):
        CompactPosterior.build(posterior.kernel, posterior.basis, broken, posterior.noise_variance)


@pytest.mark.parametrize(("term", "owner"), [("energy", "posterior"), ("friction", "basis")])
def test_terms_of_another_model_are_rejected(chain: Case, term: str, owner: str) -> None:
    with pytest.raises(ValueError, match=f"not belong to this {owner}"):
        chain.model.posterior.mean(chain.unseen, make_estimator("lip", ("revolute",) * 2).terms[term])

"""Tests of sums over samples: algebra, solutions, and conditioning on more samples."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lipcore import FitCancelledError, FitOptions, Samples, TorqueModel, train
from lipcore.data.motion import Array, Motion
from lipcore.kernels.combined import SumKernel
from lipcore.kernels.drive.kernel import Drive, DriveKernel
from lipcore.posterior.basis import Basis
from lipcore.posterior.linalg import NotPositiveDefiniteError, eigen
from lipcore.posterior.statistics import (
    Statistics,
    collect,
    decay,
    empty,
    learnt_root,
    make_solution,
    merge,
    rounding_of,
    solve,
)
from lipcore.posterior.summing import Summing, Total
from lipcore.training.conditioning import condition
from tests.choosing import slow
from tests.lipcore.oracles import random_problem
from tests.service.data import QUICK, stream

TYPES = ("revolute", "prismatic", "revolute")
NOISE = np.array([0.04, 0.01, 0.09])


def random_basis_and_samples(seed: int, samples: int = 12) -> tuple[Basis, Motion, Array]:
    """Return a basis that does not fully cover its samples, and the samples."""
    found = random_problem(TYPES, samples, seed, "chain")
    kernel = SumKernel(found.kernel, DriveKernel(Drive(len(TYPES))))
    basis = Basis.build(kernel, found.params, found.motion[:4], np.array([0, 1, 3, 5, 8, 10]))
    return basis, found.motion, np.random.default_rng(seed).standard_normal((samples, len(TYPES)))


def are_close(one: Statistics, other: Statistics) -> bool:
    scale = float(np.abs(other.a).max()) + 1e-30
    return (
        np.allclose(one.a, other.a, rtol=0, atol=1e-8 * scale)
        and np.allclose(one.b, other.b, rtol=0, atol=1e-8 * scale)
        and abs(one.samples - other.samples) <= 1e-8 * max(1.0, other.samples)
    )


def dense(basis: Basis, motion: Motion, residual: Array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Φᵀ (N n, M), noise variances and residuals, one sample at a time."""
    rows, variances = [], []
    for k in range(len(motion)):
        one = motion[k : k + 1]
        features = basis.features(one)
        rows.append(features.T)
        prior = basis.term.variance(basis.params, one)[0].diagonal()
        open_ = prior - np.square(features[: len(basis.outputs)]).sum(0)
        variances.append(NOISE + np.maximum(open_, 0.0))
    return np.concatenate(rows), np.concatenate(variances), residual.reshape(-1)


@given(st.integers(0, 10_000), st.permutations(range(12)), st.lists(st.integers(1, 11), unique=True, max_size=4))
def test_batches_and_order_do_not_change_the_sums(seed: int, order: list[int], cuts: list[int]) -> None:
    basis, motion, residual = random_basis_and_samples(seed)
    whole = collect(basis, NOISE, motion, residual)
    for edges in ([0, *sorted(cuts), 12], range(13)):
        found = empty(len(basis))
        for first, last in pairwise(edges):
            rows = np.array(order[first:last])
            found = merge(collect(basis, NOISE, motion[rows], residual[rows]), found)
        assert are_close(found, whole)


@given(st.integers(0, 10_000), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_decay_is_multiplicative(seed: int, first: float, second: float) -> None:
    basis, motion, residual = random_basis_and_samples(seed)
    one = collect(basis, NOISE, motion[:7], residual[:7])
    other = collect(basis, NOISE, motion[7:], residual[7:])
    assert are_close(decay(merge(one, other), first), merge(decay(one, first), decay(other, first)))
    assert are_close(decay(decay(one, first), second), decay(one, first * second))


def test_sums_and_solution_match_linear_regression() -> None:
    basis, motion, residual = random_basis_and_samples(5)
    rows, variances, values = dense(basis, motion, residual)
    counts = np.arange(1, 13) / 6
    variances = variances / np.repeat(counts, 3)
    found = collect(basis, NOISE, motion, residual, counts)
    assert np.allclose(found.a, rows.T @ (rows / variances[:, None]), rtol=1e-10, atol=1e-10)
    assert np.allclose(found.b, rows.T @ (values / variances), rtol=1e-10, atol=1e-10)
    assert found.samples == pytest.approx(13.0)
    assert np.array_equal(found.a, found.a.T)
    centre = np.random.default_rng(2).standard_normal(len(basis))
    solution = solve(found, centre)
    # the dual form: conditioning on the N n values themselves
    gain = rows.T @ np.linalg.inv(rows @ rows.T + np.diag(variances))
    assert np.allclose(solution.mean, centre + gain @ (values - rows @ centre), atol=1e-9)
    assert np.allclose(np.eye(len(basis)) - solution.covariance, gain @ rows, atol=1e-9)


def test_large_products_match_small_ones_and_are_symmetric() -> None:
    found = random_problem(TYPES, 100, 6, "chain")
    basis = Basis.build(found.kernel, found.params, found.motion, np.arange(300))  # more than one block
    residual = np.random.default_rng(1).standard_normal((100, 3))
    whole = collect(basis, NOISE, found.motion, residual)
    features = basis.features(found.motion)
    features /= np.sqrt(NOISE + basis.uncovered(found.motion, features)).reshape(-1)
    assert np.allclose(whole.a, features @ features.T, rtol=1e-12, atol=1e-9)
    assert np.array_equal(whole.a, whole.a.T)


@pytest.mark.parametrize(("count", "largest"), [(3, 1e2), (20, 1e2), (60, 1e2), (60, 1e5)])
@pytest.mark.parametrize("first", [0, 7, 20])
def test_solution_is_exact_and_triangular(first: int, count: int, largest: float) -> None:
    """The samples determine all 20 variables or only some, with information up to 1e10 times the prior's."""
    generator = np.random.default_rng(count)
    columns = generator.standard_normal((20, count)) * np.geomspace(1, largest, 20)[:, None]
    b, centre = generator.standard_normal((2, 20))
    found = solve(Statistics(columns @ columns.T, b, count), centre, first)
    # use the columns, as the condition number of their products is the square
    vectors, values, _ = np.linalg.svd(columns)
    values = np.concatenate([values, np.zeros(20 - len(values))]) ** 2
    learnt = (vectors * (values / (1 + values))) @ vectors.T
    mean = (vectors / (1 + values)) @ vectors.T @ (centre + b)
    assert np.allclose(np.eye(20) - found.covariance, learnt, rtol=0, atol=1e-10)
    assert np.allclose(found.mean, mean, rtol=0, atol=1e-9)
    again = make_solution(found.mean, found.covariance, first)
    assert np.allclose(again.covariance, found.covariance, rtol=0, atol=1e-9)
    whole = learnt_root(found.covariance)
    assert np.allclose((whole.T @ whole), learnt, rtol=0, atol=1e-10)
    for root in (found.root, whole):
        assert np.count_nonzero(np.triu(root, 1)) == 0


@pytest.mark.parametrize("first", [0, 7, 20])
def test_eigenvalues_replace_a_failed_cholesky(first: int, monkeypatch) -> None:
    columns = np.random.default_rng(0).standard_normal((20, 3)) * np.geomspace(1, 100, 20)[:, None]
    sums = Statistics(columns @ columns.T, np.ones(20), 3)
    expected = solve(sums, None, first)
    monkeypatch.setattr("lipcore.posterior.statistics._by_cholesky", lambda a: None)
    found = solve(sums, None, first)
    assert np.allclose(found.covariance, expected.covariance, rtol=0, atol=1e-9)
    assert np.allclose(found.mean, expected.mean, rtol=0, atol=1e-9)
    assert not np.array_equal(found.root, expected.root)
    assert np.count_nonzero(np.triu(found.root, 1)) == 0


def test_qr_iterations_replace_unconverged_divide_and_conquer(monkeypatch) -> None:
    columns = np.random.default_rng(0).standard_normal((40, 5))
    matrix = columns @ columns.T
    values, _ = eigen(matrix)
    calls = []

    def fail(a: Array) -> tuple[Array, Array]:
        calls.append(a)
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    monkeypatch.setattr(np.linalg, "eigh", fail)
    found, vectors = eigen(matrix)
    assert len(calls) == 1
    assert np.allclose(found, values, rtol=0, atol=1e-12 * values[-1])
    assert np.allclose((vectors * found) @ vectors.T, matrix, rtol=0, atol=1e-12 * values[-1])


@pytest.mark.parametrize("size", [10, 40])
def test_non_finite_matrix_has_no_eigenvalues(size: int) -> None:
    """For a large matrix, LAPACK returns a finite smallest eigenvalue and others that are NaN."""
    matrix = np.eye(size)
    matrix[size // 2, 1] = np.nan
    with pytest.raises(NotPositiveDefiniteError, match="not finite"):
        eigen(matrix)


@pytest.mark.parametrize("factor", [-0.1, 1.1, float("nan")])
def test_invalid_decay_factor_is_rejected(factor: float) -> None:
    with pytest.raises(ValueError, match="factor is"):
        decay(empty(2), factor)


def test_indefinite_statistics_are_rejected() -> None:
    basis, motion, residual = random_basis_and_samples(10)
    statistics = collect(basis, NOISE, motion, residual)
    with pytest.raises(NotPositiveDefiniteError, match="none below zero"):
        solve(replace(statistics, a=statistics.a - np.eye(len(basis))))


@pytest.fixture(scope="module")
def samples():
    return stream(samples=200)


def train_quickly(samples: Samples, estimator: str = "lip-chain", **options: Any) -> TorqueModel:
    """Train on 60 chosen samples, unless the options say otherwise."""
    options = {**QUICK, "statistics": "chosen", "device": "cpu", **options}
    return train(samples, ("revolute",) * 2, estimator, FitOptions(**options))


def test_conditioned_model_equals_a_fit_to_all_samples(samples):
    """A fit with all samples in its posterior gives the same predictions."""
    whole = train_quickly(samples, posterior_samples=200, statistics="auto")
    again = condition(whole, samples)
    half = condition(whole, samples.rows(slice(0, 100)))
    twice = condition(whole, samples, np.r_[np.ones(100), np.zeros(100)])
    assert again.fit["samples_posterior"] == 200
    query = [getattr(stream(seed=3), name) for name in ("q", "dq", "ddq")]
    whole, again, half, twice = (each.predict(*query) for each in (whole, again, half, twice))
    np.testing.assert_allclose(again.tau, whole.tau, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(again.tau_std, whole.tau_std, rtol=1e-7)
    np.testing.assert_allclose(twice.tau, half.tau, rtol=1e-9, atol=1e-9)
    assert (half.tau_std > again.tau_std).all()


@pytest.mark.parametrize("estimator", ["lip-chain", "lip", *map(slow, ("se", "gip", "lse"))])
def test_fast_sum_matches_the_statistics(estimator, samples):
    """Compare with the plain sum, sample by sample, with weights and uneven pieces."""
    posterior = train_quickly(samples, estimator, posterior_samples=40).posterior
    weights = np.random.default_rng(1).uniform(0, 1, len(samples))
    total, summing = Total.empty(len(posterior.basis)), Summing.of(posterior)
    for part in (slice(0, 77), slice(77, 200)):
        summing.add(total, samples.rows(part), weights[part])
    motion, plain = samples.motion(), empty(len(posterior.basis))
    residual, variance = samples.tau - posterior.kernel.mean(motion), posterior.row_variance(motion)
    for row in range(len(samples)):
        one = slice(row, row + 1)
        plain = merge(plain, collect(posterior.basis, variance[one], motion[one], residual[one], weights[one]))
    a = total.a + np.triu(total.a, 1).T
    assert np.abs(a - plain.a).max() <= 1e-8 * np.abs(plain.a).max()
    assert np.abs(total.b - plain.b).max() <= 1e-8 * np.abs(plain.b).max()
    assert np.array_equal(total.packed(), total.a[np.triu_indices(len(a))])


def test_torch_sums_match_numpy(samples):
    """Run the GPU code on the CPU."""
    posterior = train_quickly(samples, "se").posterior
    fast, slow = Total.empty(len(posterior.basis)), Total.empty(len(posterior.basis))
    summing = Summing.of(posterior)
    summing.add(fast, samples)
    found = summing._elsewhere(slow, samples, np.ones(len(samples)))
    np.testing.assert_allclose(np.triu(found.T @ found), fast.a, rtol=1e-8, atol=1e-8 * np.abs(fast.a).max())
    np.testing.assert_allclose(slow.b, fast.b, rtol=1e-8, atol=1e-8 * np.abs(fast.b).max())


def test_samples_beyond_the_chosen_ones_are_learnt(samples):
    faster = replace(samples, t=samples.t / 100)  # 0.2 s have no more effective samples than were chosen
    for recorded, statistics, learnt in ((samples, "auto", 200), (faster, "auto", 60), (faster, "all", 200)):
        assert train_quickly(recorded, statistics=statistics).fit["samples_posterior"] == learnt


def test_conditioning_can_be_cancelled(samples):
    with pytest.raises(FitCancelledError):
        condition(train_quickly(samples), samples, cancelled=lambda: True)


def test_exact_samples_explain_variance_to_rounding():
    above = np.diag([1e-12, 1.0, 1 + 2e-5])  # less than the rounding of 1e12 above the prior
    with pytest.raises(NotPositiveDefiniteError, match="above the prior's"):
        learnt_root(above)
    root = learnt_root(above, rounding_of(Statistics(np.diag([1e12, 0.0, 0.0]), np.zeros(3), 40.0)))
    np.testing.assert_allclose(root.T @ root, np.diag([1.0, 0.0, 0.0]), atol=1e-9)

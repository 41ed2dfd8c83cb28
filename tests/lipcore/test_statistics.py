"""Sums over samples: their algebra, and what is solved from them against dense references in plain NumPy."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lipcore.data.motion import Motion
from lipcore.kernels.base import SumKernel
from lipcore.kernels.friction import FrictionKernel
from lipcore.posterior.basis import Basis
from lipcore.posterior.linalg import NotPositiveDefiniteError
from lipcore.posterior.statistics import Statistics, collect, decay, empty, merge, solve, subtract, update
from tests.lipcore.problems import random_problem

TYPES = ("revolute", "prismatic", "revolute")
NOISE = torch.tensor([0.04, 0.01, 0.09], dtype=torch.float64)


def problem(seed: int, samples: int = 12) -> tuple[Basis, Motion, torch.Tensor]:
    """A basis of fewer torques than there are samples, and samples that it does not cover entirely."""
    found = random_problem(TYPES, samples, seed, "chain")
    kernel = SumKernel(found.kernel, FrictionKernel(len(TYPES)))
    basis = Basis.build(kernel, found.params, found.motion[:4], torch.tensor([0, 1, 3, 5, 8, 10]))
    generator = torch.Generator().manual_seed(seed)
    return basis, found.motion, torch.randn((samples, len(TYPES)), generator=generator, dtype=torch.float64)


def same(one: Statistics, other: Statistics, tolerance: float = 1e-8) -> bool:
    scale = float(other.a.abs().max()) + 1e-30
    return (
        torch.allclose(one.a, other.a, rtol=0, atol=tolerance * scale)
        and torch.allclose(one.b, other.b, rtol=0, atol=tolerance * scale)
        and abs(one.samples - other.samples) <= tolerance * max(1.0, other.samples)
    )


def dense(basis: Basis, motion: Motion, residual: torch.Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Φᵀ (N n, M), noise variances and residuals as NumPy arrays, sample by sample, one query at a time."""
    rows, variances = [], []
    for k in range(len(motion)):
        one = motion[k : k + 1]
        features = basis.features(one).numpy()
        rows.append(features.T)
        assert basis.term is not None
        prior = basis.term.variance(basis.params, one)[0].diagonal().numpy()
        open_ = prior - np.square(features[: len(basis.outputs)]).sum(0)
        variances.append(NOISE.numpy() + np.maximum(open_, 0.0))
    return np.concatenate(rows), np.concatenate(variances), residual.numpy().reshape(-1)


@given(st.integers(0, 10_000), st.permutations(range(12)), st.lists(st.integers(1, 11), unique=True, max_size=4))
def test_all_at_once_in_parts_in_any_order_and_one_by_one_are_the_same(
    seed: int, order: list[int], cuts: list[int]
) -> None:
    basis, motion, residual = problem(seed)
    whole = collect(basis, NOISE, motion, residual)
    parts, one_by_one = empty(len(basis)), empty(len(basis))
    edges = [0, *sorted(cuts), 12]
    for first, last in pairwise(edges):
        rows = torch.tensor(order[first:last])
        parts = merge(collect(basis, NOISE, motion[rows], residual[rows]), parts)
    for k in order:
        one_by_one = update(one_by_one, basis, NOISE, motion[k : k + 1], residual[k : k + 1])
    assert same(parts, whole)
    assert same(one_by_one, whole)


@given(st.integers(0, 10_000), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_what_is_added_can_be_taken_back_and_ages_factor(seed: int, first: float, second: float) -> None:
    basis, motion, residual = problem(seed)
    one = collect(basis, NOISE, motion[:7], residual[:7])
    other = collect(basis, NOISE, motion[7:], residual[7:])
    assert same(subtract(merge(one, other), other), one)
    assert same(decay(merge(one, other), first), merge(decay(one, first), decay(other, first)))
    assert same(decay(decay(one, first), second), decay(one, first * second))


def test_sums_are_those_of_every_sample_by_itself_and_their_solution_that_of_linear_regression() -> None:
    basis, motion, residual = problem(5)
    rows, variances, values = dense(basis, motion, residual)
    counts = torch.arange(1, 13, dtype=torch.float64) / 6
    variances = variances / np.repeat(counts.numpy(), 3)
    found = collect(basis, NOISE, motion, residual, counts)
    assert np.allclose(found.a.numpy(), rows.T @ (rows / variances[:, None]), rtol=1e-10, atol=1e-10)
    assert np.allclose(found.b.numpy(), rows.T @ (values / variances), rtol=1e-10, atol=1e-10)
    assert found.samples == pytest.approx(13.0)
    assert torch.equal(found.a, found.a.T)
    centre = torch.randn(len(basis), generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    solution = solve(found, centre)
    # the dual form: conditioning on the N n values themselves
    gain = rows.T @ np.linalg.inv(rows @ rows.T + np.diag(variances))
    assert np.allclose(solution.mean.numpy(), centre.numpy() + gain @ (values - rows @ centre.numpy()), atol=1e-9)
    assert np.allclose((solution.learnt.T @ solution.learnt).numpy(), gain @ rows, atol=1e-9)


def test_large_products_are_symmetric_and_those_of_small_ones() -> None:
    found = random_problem(TYPES, 100, 6, "chain")
    basis = Basis.build(found.kernel, found.params, found.motion, torch.arange(300))  # more than one block
    residual = torch.randn((100, 3), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    whole = collect(basis, NOISE, found.motion, residual)
    features = basis.features(found.motion) * (
        (NOISE + basis.uncovered(found.motion, basis.features(found.motion))).rsqrt().reshape(-1)
    )
    assert torch.allclose(whole.a, features @ features.T, rtol=1e-12, atol=1e-9)
    assert torch.equal(whole.a, whole.a.T)


@pytest.mark.parametrize(("told", "largest"), [(3, 1e2), (20, 1e2), (60, 1e2), (60, 1e5)])
def test_what_is_learnt_is_exact_and_triangular(told: int, largest: float) -> None:
    """From samples that tell of all 20 variables or only of some, as much of one as 1e10 times another's prior."""
    generator = np.random.default_rng(told)
    columns = generator.standard_normal((20, told)) * np.geomspace(1, largest, 20)[:, None]
    b, centre = generator.standard_normal(20), generator.standard_normal(20)
    found = solve(
        Statistics(torch.from_numpy(columns @ columns.T), torch.from_numpy(b), told), torch.from_numpy(centre)
    )
    # from the columns and not from their products, whose condition number is the square
    vectors, values, _ = np.linalg.svd(columns)
    values = np.concatenate([values, np.zeros(20 - len(values))]) ** 2
    learnt = (vectors * (values / (1 + values))) @ vectors.T
    mean = (vectors / (1 + values)) @ vectors.T @ (centre + b)
    assert np.allclose((found.learnt.T @ found.learnt).numpy(), learnt, rtol=0, atol=1e-10)
    assert np.allclose(found.mean.numpy(), mean, rtol=0, atol=1e-9)
    assert torch.count_nonzero(found.learnt.triu(1)) == 0


def test_without_data_the_prior_is_left() -> None:
    found = solve(empty(5), torch.arange(5.0, dtype=torch.float64))
    assert torch.equal(found.mean, torch.arange(5.0, dtype=torch.float64))
    assert torch.equal(found.learnt, torch.zeros((5, 5), dtype=torch.float64))


@pytest.mark.parametrize("factor", [-0.1, 1.1, float("nan")])
def test_ages_that_are_none_are_refused(factor: float) -> None:
    with pytest.raises(ValueError, match="factor is"):
        decay(empty(2), factor)


def test_statistics_of_no_samples_are_refused() -> None:
    basis, motion, residual = problem(10)
    statistics = collect(basis, NOISE, motion, residual)
    with pytest.raises(NotPositiveDefiniteError, match="none below zero"):
        solve(replace(statistics, a=statistics.a - torch.eye(len(basis), dtype=torch.float64)))

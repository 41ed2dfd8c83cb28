"""Tests of sample selection, pivoted Cholesky, and factors with jitter."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from lipcore.data.motion import Motion
from lipcore.posterior.linalg import NotPositiveDefiniteError, cholesky
from lipcore.posterior.selection import PREFERENCE, TargetFunction, pivots, spread_out


def test_repeated_samples_are_selected_once() -> None:
    postures = np.random.default_rng(0).normal(size=(3, 3, 3))
    motion = Motion.from_arrays(*postures[:, np.arange(60) % 3])  # a robot that holds three postures
    chosen = spread_out(motion, 10)
    assert len(set(chosen.tolist())) == 10
    assert chosen.tolist() == sorted(spread_out(motion, 10).tolist())
    assert spread_out(motion, 99).tolist() == list(range(60))  # no more are available


def test_rare_regions_are_represented() -> None:
    rng = np.random.default_rng(1)
    q, dq, ddq = 0.05 * rng.normal(size=(3, 500, 3))
    q[17, 0], dq[171, 1], ddq[333, 2] = 2.5, 4.0, -9.0
    chosen = spread_out(Motion.from_arrays(q, dq, ddq), 10).tolist()
    assert {17, 171, 333} <= set(chosen)


@given(st.integers(1, 8), st.integers(1, 4), st.integers(1, 30), st.integers(1, 40), st.integers(0, 99))
def test_every_prefix_is_a_cholesky_factor(samples, per_sample, rank, max_outputs, seed) -> None:
    factor = np.random.default_rng(seed).normal(size=(samples * per_sample, rank)) * np.logspace(1, -2, rank)
    gram = factor @ factor.T
    before = gram.copy()
    found = pivots(gram, per_sample, max_outputs, 1e-9)
    assert np.array_equal(gram, before)
    chosen, scale = found.outputs, float(gram.diagonal().max())
    assert len(set(chosen.tolist())) == len(chosen) <= min(max_outputs, len(gram))
    for count in {1, len(chosen) // 2, len(chosen)} - {0}:
        picked, lower = chosen[:count], found.lower[:, :count]
        square = lower[picked]
        above = np.abs(np.triu(square, 1)).max()
        assert above == 0 or above < 1e-6 * scale**0.5
        assert np.allclose(square @ square.T, gram[picked][:, picked], rtol=0, atol=1e-7 * scale)
        left = gram.diagonal() - np.square(lower).sum(1)
        assert left.min() > -1e-7 * scale
    assert (np.diff(found.residual) <= 1e-9 * scale).all()  # the residual never grows


def test_outputs_of_selected_samples_come_first() -> None:
    """A new sample wins with ten times the variance, and loses with less."""
    variances = np.array([4.0, 1.0, 1.1, 1.0 * PREFERENCE * 1.5, 3.0, 2.0])
    order = pivots(np.diag(variances), 2, 6, 0.0).outputs.tolist()
    assert order[0] == 3  # the largest of all, in the second sample
    assert order[1] == 2  # its neighbour, although others are larger
    assert sorted(order) == list(range(6))


def test_first_outputs_are_where_the_interpolation_of_values_fails_most() -> None:
    places = np.random.default_rng(2).normal(size=(60, 2))
    gram = np.exp(-0.5 * cdist(places, places, "sqeuclidean"))
    values = np.sin(3 * places[:, 0]) * np.exp(-np.square(places[:, 1]))
    weights = np.linspace(0.1, 1.0, 60)
    found = pivots(gram, 1, 20, 1e-9, TargetFunction(values, 8, weights)).outputs
    for count in range(8):
        some = found[:count]
        error = values - gram[:, some] @ np.linalg.solve(gram[np.ix_(some, some)], values[some])
        assert np.abs(error).argmax() == found[count]
    some = found[:8]
    explained = gram[:, some] @ np.linalg.solve(gram[np.ix_(some, some)], gram[some])
    assert (weights * (1 - explained.diagonal())).argmax() == found[8]
    nothing = TargetFunction(np.zeros(60), 8, np.zeros(60))
    assert pivots(gram, 1, 20, 1e-9, nothing).outputs.tolist() == pivots(gram, 1, 20, 1e-9).outputs.tolist()


def test_factor_solves_whitens_and_has_log_determinant() -> None:
    root = np.random.default_rng(0).standard_normal((6, 6))
    matrix = root @ root.T + np.eye(6)
    factor, right = cholesky(matrix), matrix[:, :2]
    assert factor.jitter == 0
    assert np.allclose(matrix @ factor.solve(right), right, rtol=0, atol=1e-12)
    assert np.allclose(factor.solve(right[:, 0]), factor.solve(right)[:, 0], rtol=0, atol=1e-14)
    white = factor.whiten(right)
    assert np.allclose(white.T @ white, right.T @ np.linalg.inv(matrix) @ right, rtol=1e-10, atol=0)
    assert np.allclose(factor.log_determinant(), np.linalg.slogdet(matrix).logabsdet, rtol=1e-12, atol=0)


@pytest.mark.parametrize("jitter", [1e-12, 1e-11, 1e-10, 1e-9, 1e-8])
def test_smallest_sufficient_jitter_is_used_and_reported(jitter: float) -> None:
    matrix = np.diag(np.array([2.0, 4.0, 6.0, 0.0]))
    # off by half of this jitter, five times the previous one
    matrix[3, 3] = -0.5 * jitter * 3.0
    factor = cholesky(matrix)
    assert factor.jitter == pytest.approx(jitter * 3.0, rel=1e-6)
    shifted = matrix + factor.jitter * np.eye(4)
    assert np.allclose(factor.lower @ factor.lower.T, shifted, rtol=1e-12, atol=1e-25)


def test_jitter_fixes_singular_but_not_indefinite_matrices() -> None:
    assert 0 < cholesky(np.ones((4, 4))).jitter <= 1e-11
    matrix = np.diag(np.array([1.0, 1.0, -1e-6]))
    with pytest.raises(NotPositiveDefiniteError, match="size 3 is not positive definite"):
        cholesky(matrix)
    matrix[2, 1] = float("nan")
    with pytest.raises(NotPositiveDefiniteError, match="not finite"):
        cholesky(matrix)

"""Matrices to twice the digits of float64, beside fractions."""

from fractions import Fraction

import numpy as np
import pytest

from lipcore.files.twofold import Twofold, upper_root

exactly = np.frompyfunc(Fraction, 1, 1)


def value(matrix: Twofold) -> np.ndarray:
    return exactly(matrix.high) + exactly(matrix.low)


def worst(found: np.ndarray, expected: np.ndarray) -> float:
    """Largest deviation over the largest number."""
    return float(abs(found - expected).max() / abs(expected).max())


def test_arithmetic_keeps_twice_the_digits():
    rng = np.random.default_rng(0)
    one, other = rng.standard_normal((9, 12)), rng.standard_normal((12, 9)) * 10.0 ** rng.integers(-6, 6, (12, 9))
    product = Twofold.of(one) @ Twofold.of(other)
    assert worst(value(product), exactly(one) @ exactly(other)) < 1e-30
    scaled = product * Twofold.of(other.T[:, :9]) - product.T
    expected = value(product) * exactly(other.T[:, :9]) - value(product).T
    assert worst(value(scaled), expected) < 1e-30
    assert worst(value(scaled.sums()), value(scaled).sum(1, keepdims=True)) < 1e-30


def test_a_root_has_all_digits_where_little_is_left():
    """A covariance of which all but 1e-12 is known in most directions, as a difference of nearly equal matrices."""
    rng, size = np.random.default_rng(1), 12
    known = np.tril(np.linalg.qr(rng.standard_normal((size, size)))[1].T) * np.sqrt(1 - 1e-12)
    before = Twofold.of(known).T @ Twofold.of(known)
    left = rng.standard_normal((size, size)) * 10.0 ** rng.uniform(-7, -5, size)
    matrix = before - -(Twofold.of(left).T @ Twofold.of(left)) - before
    root = upper_root(matrix)
    assert not np.tril(root, -1).any()
    expected = exactly(left).T @ exactly(left)
    difference = abs(exactly(root) @ exactly(root).T - expected)
    scale = np.sqrt(np.diagonal(expected).astype(float))
    assert (difference.astype(float) / np.outer(scale, scale)).max() < 1e-15
    with pytest.raises(ValueError, match="not positive definite to rounding, at 11 of 12"):
        upper_root(-matrix)

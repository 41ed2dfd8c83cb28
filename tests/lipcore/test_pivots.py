"""Pivoted Cholesky: what it promises of any covariance matrix."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lipcore.posterior.selection import PREFERENCE, pivots


def gram_of(rows: int, rank: int, seed: int) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(rows, rank)) * np.logspace(1, -2, rank)
    return torch.from_numpy(factor @ factor.T)


@given(st.integers(1, 8), st.integers(1, 4), st.integers(1, 30), st.integers(1, 40), st.integers(0, 99))
def test_every_prefix_is_a_cholesky_factor(samples: int, per_sample: int, rank: int, most: int, seed: int) -> None:
    gram = gram_of(samples * per_sample, rank, seed)
    before = gram.clone()
    found = pivots(gram, per_sample, most, 1e-9)
    assert torch.equal(gram, before)
    chosen = found.outputs.tolist()
    assert len(set(chosen)) == len(chosen) <= min(most, len(gram))
    scale = float(gram.diagonal().max())
    for count in {1, len(chosen) // 2, len(chosen)} - {0}:
        picked, lower = found.outputs[:count], found.lower[:, :count]
        square = lower[picked]
        assert torch.equal(square.triu(1), torch.zeros_like(square)) or square.triu(1).abs().max() < 1e-6 * scale**0.5
        assert torch.allclose(square @ square.T, gram[picked][:, picked], rtol=0, atol=1e-7 * scale)
        left = gram.diagonal() - lower.square().sum(1)
        assert left.min() > -1e-7 * scale
    assert (found.residual.diff() <= 1e-9 * scale).all()  # what is left never grows


def test_it_goes_on_until_the_residual_is_small_enough() -> None:
    gram = gram_of(60, 25, seed=1)
    found = pivots(gram, 3, 60, 1e-3)
    left = gram.diagonal() - found.lower.square().sum(1)
    assert left.max() <= 1e-3 < found.residual[-1]
    assert len(found) < 26  # the rank is all that can be found


def test_outputs_of_samples_in_use_come_first() -> None:
    """Independent outputs: with ten times the variance a new sample wins, with less it does not."""
    variances = torch.tensor([4.0, 1.0, 1.1, 1.0 * PREFERENCE * 1.5, 3.0, 2.0], dtype=torch.float64)
    order = pivots(torch.diag(variances), 2, 6, 0.0).outputs.tolist()
    assert order[0] == 3  # the largest of all, in the second sample
    assert order[1] == 2  # its neighbour, although others are larger
    assert sorted(order) == list(range(6))


@pytest.mark.parametrize("most", [1, 5])
def test_no_more_than_asked_for(most: int) -> None:
    assert len(pivots(gram_of(30, 20, seed=2), 3, most, 0.0)) == most

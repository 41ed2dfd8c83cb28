"""A fitted model that is told of more samples than its fit stands on."""

from __future__ import annotations

import numpy as np
import pytest

import lipcore
from lipcore.online.conditioning import condition
from tests.service.data import QUICK, stream


def test_a_conditioned_model_knows_all_samples():
    """A fit that takes all samples into its posterior knows no more, up to its own compression."""
    samples = stream(samples=200)
    options = {"hyperparameter_samples": 20, "max_iterations": 4}
    few = lipcore.train(samples, ["revolute"] * 2, options=lipcore.FitOptions(**options, posterior_samples=200))
    again = condition(few, samples)
    query = [getattr(stream(seed=3), name) for name in ("q", "dq", "ddq")]
    np.testing.assert_allclose(again.predict(*query).tau, few.predict(*query).tau, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(again.predict(*query).tau_std, few.predict(*query).tau_std, rtol=1e-7)

    half = condition(few, samples.rows(slice(0, 100)))
    twice = condition(few, samples, np.r_[np.ones(100), np.zeros(100)])
    np.testing.assert_allclose(twice.predict(*query).tau, half.predict(*query).tau, rtol=1e-9, atol=1e-9)
    assert (half.predict(*query).tau_std > again.predict(*query).tau_std).all()
    assert again.fit["samples_posterior"] == 200


def test_conditioning_can_be_cancelled():
    samples = stream(samples=200)
    model = lipcore.train(samples, ["revolute"] * 2, options=lipcore.FitOptions(**QUICK))
    with pytest.raises(lipcore.FitCancelledError):
        condition(model, samples, cancelled=lambda: True)

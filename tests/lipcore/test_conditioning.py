"""A fitted model that is told of more samples than its fit stands on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import lipcore
from lipcore.data import independence
from lipcore.fitting.options import FitOptions
from lipcore.posterior.statistics import collect, empty, merge
from lipcore.posterior.summing import Summing, Total
from lipcore.training.conditioning import condition, should_condition
from tests.service.data import QUICK, stream

TWO = ["revolute"] * 2
SAME = 1e-6
"""Share of the largest number by which two fits to the same samples may differ."""
FEW = {"hyperparameter_samples": 20, "max_iterations": 4}


@pytest.fixture(scope="module")
def samples():
    return stream(samples=200)


@pytest.fixture(scope="module")
def few(samples):
    """A model that stands on 60 of 200 samples."""
    return lipcore.train(samples, TWO, "lip-chain", FitOptions(**QUICK, statistics="chosen"))


def same(one, other):
    """Whether two models, each fitted by itself, are the same but for rounding, which the steps of a search magnify."""
    if one.posterior.statistics.a.shape != other.posterior.statistics.a.shape:
        return False
    pairs = [(getattr(each.posterior.statistics, name) for each in (one, other)) for name in ("a", "b")]
    alike = all(torch.allclose(x, y, rtol=0, atol=SAME * float(y.abs().max())) for x, y in pairs)
    return alike and one.training_range == other.training_range


def test_a_conditioned_model_knows_all_samples(samples):
    """A fit that takes all samples into its posterior knows no more, up to its own compression."""
    few = lipcore.train(samples, TWO, "lip-chain", FitOptions(**FEW, posterior_samples=200))
    again = condition(few, samples)
    query = [getattr(stream(seed=3), name) for name in ("q", "dq", "ddq")]
    np.testing.assert_allclose(again.predict(*query).tau, few.predict(*query).tau, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(again.predict(*query).tau_std, few.predict(*query).tau_std, rtol=1e-7)

    half = condition(few, samples.rows(slice(0, 100)))
    twice = condition(few, samples, np.r_[np.ones(100), np.zeros(100)])
    np.testing.assert_allclose(twice.predict(*query).tau, half.predict(*query).tau, rtol=1e-9, atol=1e-9)
    assert (half.predict(*query).tau_std > again.predict(*query).tau_std).all()
    assert again.fit["samples_posterior"] == 200


@pytest.mark.parametrize("estimator", ["lip-chain", "lip", "se", "gip", "lse"])
def test_the_fast_sum_is_that_of_the_statistics(estimator, samples):
    """Against the plain sum, sample by sample, with weights, over pieces that do not divide the whole."""
    options = FitOptions(**{**QUICK, "posterior_samples": 40}, statistics="chosen", device="cpu")
    posterior = lipcore.train(samples, TWO, estimator, options).posterior
    weights = np.random.default_rng(1).uniform(0, 1, len(samples))
    total, summing = Total.empty(len(posterior.basis)), Summing.of(posterior)
    for part in (slice(0, 77), slice(77, 200)):
        summing.add(total, samples.rows(part), weights[part])
    motion, slow = samples.motion(), empty(len(posterior.basis))
    residual = samples.torque() - posterior.kernel.mean(motion)
    for row in range(len(samples)):
        one, weight = slice(row, row + 1), torch.tensor(weights[row : row + 1])
        slow = merge(slow, collect(posterior.basis, posterior.noise_variance, motion[one], residual[one], weight))
    a = total.a + np.tril(total.a, -1).T
    assert np.abs(a - slow.a.numpy()).max() <= 1e-8 * slow.a.abs().max()
    assert np.abs(total.b - slow.b.numpy()).max() <= 1e-8 * slow.b.abs().max()
    assert np.array_equal(total.packed(), total.a.T[np.triu_indices(len(a))])


def test_the_form_of_other_devices_sums_alike(few, samples):
    """Torch's form, which is for GPUs, here on the CPU."""
    fast, slow = Total.empty(len(few.posterior.basis)), Total.empty(len(few.posterior.basis))
    summing = Summing.of(few.posterior)
    summing.add(fast, samples)
    found = summing._elsewhere(slow, samples, np.ones(len(samples)))
    np.testing.assert_allclose(np.tril(found.T @ found), fast.a, rtol=1e-8, atol=1e-8 * np.abs(fast.a).max())
    np.testing.assert_allclose(slow.b, fast.b, rtol=1e-8, atol=1e-8 * np.abs(fast.b).max())


def test_what_is_worth_more_than_the_chosen_ones_is_learnt_whole(samples):
    options = FitOptions(**QUICK)
    assert same(lipcore.train(samples, TWO, "lip-chain", options), condition_timed(samples, options))
    faster = replace(samples, t=samples.t / 100)  # two tenths of a second: no more than the few that were chosen
    assert same(lipcore.train(faster, TWO, "lip-chain", options), chosen(faster, options))
    every = replace(options, statistics="all")
    assert lipcore.train(faster, TWO, "lip-chain", every).fit["samples_posterior"] == 200


def chosen(samples, options):
    return lipcore.train(samples, TWO, "lip-chain", replace(options, statistics="chosen"))


def condition_timed(samples, options):
    return condition(chosen(samples, options), samples, independence.recording_weights(samples.t, samples.episode))


@pytest.mark.parametrize(
    ("statistics", "count", "worth", "expected"),
    [
        ("auto", 500, 500.0, False),
        ("auto", 501, 500.0, False),
        ("auto", 501, 501.0, True),
        ("all", 501, 3.0, True),
        ("all", 500, 500.0, False),
        ("chosen", 10**6, 1e6, False),
    ],
)
def test_when_all_samples_are_wanted(statistics, count, worth, expected):
    assert should_condition(FitOptions(statistics=statistics), count, worth) is expected


def test_conditioning_can_be_cancelled(few, samples):
    with pytest.raises(lipcore.FitCancelledError):
        condition(few, samples, cancelled=lambda: True)

"""A fitted model that is told of more samples than its fit stands on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import lipcore
from lipcore.data import independence
from lipcore.fitting import noise
from lipcore.fitting.options import FitOptions
from lipcore.posterior.statistics import collect, empty, merge
from lipcore.posterior.summing import Summing, Total
from lipcore.training.conditioning import condition, should_condition, sum_samples, with_statistics
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


def test_parts_are_added_to_the_whole(few, samples):
    summing = Summing.of(few.posterior)
    parts = sum_samples(summing, samples.rows(slice(0, 90))) + sum_samples(summing, samples.rows(slice(90, 200)))
    whole = sum_samples(summing, samples)
    np.testing.assert_allclose(parts.a, whole.a, rtol=1e-9, atol=1e-9 * np.abs(whole.a).max())
    assert (parts.weight, parts.low.tolist(), parts.high.tolist()) == (200.0, whole.low.tolist(), whole.high.tolist())
    model = with_statistics(few, parts, 200)
    assert model.training_range["dq"]["max"] == samples.dq.max(0).tolist()
    assert model.fit["samples_posterior"] == 200


def test_what_is_worth_more_than_the_chosen_ones_is_learnt_whole(samples):
    options = FitOptions(**QUICK)
    assert same(lipcore.train(samples, TWO, "lip-chain", options), condition_timed(samples, options))
    faster = replace(samples, t=samples.t / 100)  # two tenths of a second: no more than the few that were chosen
    assert same(lipcore.train(faster, TWO, "lip-chain", options), chosen(faster, options))
    every = replace(options, statistics="all")
    assert lipcore.train(faster, TWO, "lip-chain", every).fit["samples_posterior"] == 200


def test_few_samples_are_learnt_as_ever(samples):
    """Where all are chosen there is nothing more to sum up: the same model."""
    part = samples.rows(slice(0, QUICK["posterior_samples"]))
    models = [lipcore.train(part, TWO, "lip-chain", FitOptions(**QUICK, statistics=how)) for how in ("all", "chosen")]
    assert same(*models)


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


def test_options_know_their_words():
    with pytest.raises(ValueError, match="statistics is 'some', expected one of auto, all, chosen"):
        FitOptions(statistics="some")


def test_conditioning_can_be_cancelled(few, samples):
    with pytest.raises(lipcore.FitCancelledError):
        condition(few, samples, cancelled=lambda: True)


def test_thinned_samples_do_not_tell_the_noise():
    """Contiguous stretches do, however far apart the samples of the fit are."""
    fast = stream(samples=12_000, rate=200.0, noise=0.01)
    thinned = fast.rows(slice(None, None, 200))
    start = noise.start
    assert (start(thinned, fast.rows(slice(0, 500))) < 0.5 * start(thinned)).all()
    np.testing.assert_allclose(start(thinned, fast.rows(slice(0, 500))), start(fast), rtol=0.5)


@pytest.mark.parametrize("rate", [1000.0, 100.0, 8.0])
def test_rows_of_a_recording_count_for_their_time(rate):
    time = np.r_[np.arange(50) / rate, 5 + np.arange(50) / rate, 9.0]
    episode = np.r_[np.zeros(50), np.ones(50), 2].astype(np.int64)
    found = independence.recording_weights(time, episode)
    np.testing.assert_allclose(found, np.r_[np.full(100, min(1.0, 10 / rate)), 1.0], rtol=1e-9)
    # a piece with one more row at both ends knows what the whole knows
    np.testing.assert_array_equal(independence.recording_weights(time[29:72], episode[29:72])[1:-1], found[30:71])
    assert len(independence.recording_weights(np.empty(0), np.empty(0, np.int64))) == 0

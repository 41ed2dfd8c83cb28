"""Tests of conformal scales, against posteriors without a block and against their guarantee."""

import numpy as np
import pytest

from lipcore import FitOptions, Samples, TorqueModel, TorquePrediction, train
from lipcore.data.metrics import LEVEL, blocks, evaluate, quantile
from lipcore.data.samples import Array
from lipcore.data.splits import GUARD_S
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.conformal import Conformal, _quantile, fit_conformal, scores
from lipcore.posterior.statistics import collect
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate

TYPES = ("revolute",) * 2
QUICK_OPTIONS = FitOptions(hyperparameter_samples=40, posterior_samples=150, max_iterations=10, starts=1, device="cpu")


def simulate_pendulum(seed: int, n_samples: int = 50) -> Samples:
    stream = Simulation(n_samples=n_samples, rate=10.0, speed=5.0, noise=0.05)
    return simulate(load_robot("double-pendulum"), stream, seed)


@pytest.fixture(scope="module")
def samples() -> Samples:
    return Samples.concatenate([simulate_pendulum(seed) for seed in (1, 2)])


@pytest.fixture(scope="module", params=["rigid-body", "lip-chain"])
def model(request: pytest.FixtureRequest, samples: Samples) -> TorqueModel:
    return train(samples, TYPES, request.param, QUICK_OPTIONS)


def posterior_of(model: TorqueModel, samples: Samples, variance: Array) -> CompactPosterior:
    """Return the posterior of these samples, with a variance per torque."""
    old, motion = model.posterior, samples.motion()
    statistics = collect(old.basis, variance, motion, samples.tau - old.kernel.mean(motion))
    return CompactPosterior.build(old.kernel, old.basis, statistics, old.noise_variance, 1.5, old.misfit)


def test_scores_match_posteriors_without_the_block(model: TorqueModel, samples: Samples) -> None:
    starts, noise = blocks(samples), model.posterior.noise_variance
    variance = noise * np.random.default_rng(0).uniform(1, 3, samples.tau.shape)
    found = scores(posterior_of(model, samples, variance), samples, variance, starts)
    assert len(starts) == 10
    for first, last in zip(starts, [*starts[1:], len(samples)], strict=True):
        near = np.abs(samples.t[:, None] - samples.t[first:last]).min(axis=1) < GUARD_S
        kept = ~(near & (samples.episode == samples.episode[first]))
        assert 90 >= kept.sum() >= 86
        without = posterior_of(model, samples.rows(kept), variance[kept])
        answer = without.predict(samples.rows(slice(first, last)).motion())
        half = quantile(LEVEL) * np.sqrt(answer.std**2 + noise)
        expected = np.abs(samples.tau[first:last] - answer.mean) / half
        np.testing.assert_allclose(found[first:last], expected, rtol=1e-5, atol=1e-8)


def test_sample_order_does_not_matter(model: TorqueModel, samples: Samples) -> None:
    order = np.random.default_rng(1).permutation(len(samples))
    variance = 2 * np.broadcast_to(model.posterior.noise_variance, samples.tau.shape)
    posterior = posterior_of(model, samples, variance)
    found, expected = (fit_conformal(posterior, each, variance) for each in (samples.rows(order), samples))
    np.testing.assert_allclose(found.scale, expected.scale, rtol=1e-9)


def block_scores(rng: np.random.Generator, count: int, rows: int) -> np.ndarray:
    """Return scores in blocks, each with its own size, (count rows, 1)."""
    size = np.repeat(np.exp(0.5 * rng.standard_normal(count)), rows)
    return np.asarray(np.abs(size * rng.standard_normal(count * rows))[:, None])


@pytest.mark.parametrize("count", [6, 30])
def test_coverage_is_at_least_the_guarantee(count: int) -> None:
    """Test unseen blocks over many recordings; few blocks guarantee less."""
    rng, rows = np.random.default_rng(2), 20
    coverages, guarantees = [], []
    for _ in range(400):
        scale, guaranteed = _quantile(block_scores(rng, count, rows), np.full(count, rows))
        coverages.append(np.mean(block_scores(rng, 20, rows) <= scale[0]))
        guarantees.append(guaranteed[0])
    assert np.mean(coverages) >= np.mean(guarantees) - 0.005
    if count >= 19:
        assert min(guarantees) > LEVEL - 1e-9
    else:
        assert max(guarantees) <= count / (count + 1)
        assert np.mean(guarantees) > 0.95 * count / (count + 1) - 1e-9


def test_intervals_are_never_narrowed() -> None:
    scale, guaranteed = _quantile(np.full((40, 1), 0.1), np.full(4, 10))
    assert (scale, guaranteed) == ((1.0,), (0.8,))


def test_scale_corrects_an_underestimated_noise(model: TorqueModel, samples: Samples) -> None:
    """A model with a tenth of the noise has low coverage; its scale corrects that."""
    old, motion = model.posterior, samples.motion()
    tenth = old.noise_variance / 100
    statistics = collect(old.basis, tenth, motion, samples.tau - old.kernel.mean(motion))
    overconfident = CompactPosterior.build(old.kernel, old.basis, statistics, tenth)
    found = fit_conformal(overconfident, samples, np.broadcast_to(tenth, samples.tau.shape))
    assert min(found.scale) > 3
    unseen = simulate_pendulum(9, 200)
    answer = overconfident.predict(unseen.motion())
    given = unseen.tau, answer.mean, answer.std, np.sqrt(tenth)
    assert (evaluate(*given).coverage < 0.6).all()
    assert (evaluate(*given, np.array(found.scale)).coverage > 0.85).all()


def test_trained_models_have_a_conformal_scale(model: TorqueModel, samples: Samples) -> None:
    assert model.conformal.blocks == 10  # seconds
    assert max(model.conformal.guaranteed) <= 10 / 11
    answer = model.predict(samples.q, samples.dq, samples.ddq)
    assert isinstance(answer, TorquePrediction)
    assert answer.scale.tolist() == list(model.conformal.scale) == model.scale.tolist()
    assert (answer.interval.scale == answer.scale).all()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (((0.5,), (0.9,), 20), "scale is"),
        (((float("inf"),), (0.9,), 20), "scale is"),
        (((1.0,), (1.0,), 20), "guaranteed is"),
        (((1.0, 1.0), (0.9,), 20), "guaranteed is"),
        (((1.0,), (0.9,), 0), "blocks is 0"),
    ],
)
def test_invalid_conformal_values_are_rejected(values: tuple[tuple[float], tuple[float], int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Conformal(*values)

"""Tests that corrupt rows are left out of training and sound rows are kept."""

from dataclasses import replace

import numpy as np
import pytest

import lipcore
from lipcore.data import outliers
from lipcore.data.outliers import CorruptRowsError, find_in_blocks, find_in_samples
from lipcore.data.samples import Samples
from lipcore.estimators.options import FitOptions
from lipcore.robots.dirt import Dirt
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from tests.choosing import slow

ROBOT = load_robot("double-pendulum")
NOISE = 0.05
CLEAN_SAMPLES = simulate(ROBOT, Simulation(300, 20.0, noise=NOISE, speed=3.0, coulomb=0.3, viscous=0.1), 41)
ROW = 110
"""A row away from reversals, where friction jumps without corruption."""
QUICK_OPTIONS = FitOptions(hyperparameter_samples=40, posterior_samples=80, max_iterations=3, starts=1)


def add_spikes(samples, *spikes):
    """Return samples with (quantity, row, joint, amount) added."""
    arrays = {name: getattr(samples, name).copy() for name in outliers.MAX_VALUES}
    for name, row, joint, amount in spikes:
        arrays[name][row, joint] += amount
    return replace(samples, **arrays)


def corrupt_rows(samples):
    return np.flatnonzero(find_in_samples(samples).rows).tolist()


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize(
    ("quantity", "amount"),
    [("tau", 1e12), ("tau", -1e4), ("tau", 50 * NOISE), ("q", 1.0), ("dq", -3.0), ("ddq", 60.0), ("q", 1e308)],
)
def test_single_corrupt_row_is_found(quantity, amount, joint):
    assert corrupt_rows(add_spikes(CLEAN_SAMPLES, (quantity, ROW, joint, amount))) == [ROW]


def test_several_corrupt_rows_are_reported_with_reasons():
    found = find_in_samples(add_spikes(CLEAN_SAMPLES, ("tau", 20, 0, 1e12), ("tau", 21, 1, 4.0), ("dq", 200, 0, 3.0)))
    assert found.report() == {"rows": 3, "first": [20, 21, 200], "why": {"magnitude": 1, "course": 2}}
    assert found.fit_entries()["samples_corrupt"] == 3
    assert "rows 20, 21, 200" in found.fit_entries()["corrupt"]
    assert find_in_samples(CLEAN_SAMPLES).fit_entries() == {}


def test_row_order_does_not_matter():
    order = np.random.default_rng(3).permutation(len(CLEAN_SAMPLES))
    shuffled = add_spikes(CLEAN_SAMPLES, ("tau", 77, 1, 3.0)).rows(order)
    assert order[corrupt_rows(shuffled)].tolist() == [77]


def test_too_many_corrupt_rows_are_an_error():
    spikes = [("tau", row, 0, 1e9) for row in range(10, 80, 10)]
    with pytest.raises(CorruptRowsError, match=r"7 corrupt of 300 \(the first are 11, 21, .*, expected at most 6"):
        find_in_samples(add_spikes(CLEAN_SAMPLES, *spikes))
    assert len(corrupt_rows(add_spikes(CLEAN_SAMPLES, *spikes[:6]))) == 6


SOUND_STREAMS = {
    "sinusoids": Simulation(300, 10.0),
    "noiseless": Simulation(300, 10.0, noise=0.0),
    "fast": Simulation(300, 10.0, speed=10.0),
    "friction": Simulation(300, 10.0, speed=5.0, coulomb=1.0, viscous=0.3),
    "rests": Simulation(300, 20.0, course="rests", coulomb=1.0),
    "rests at 100 Hz": Simulation(600, 100.0, course="rests", speed=2.0, coulomb=1.0),
    "periodic": Simulation(300, 20.0, course="periodic", speed=5.0),
    "dirt": Simulation(400, 20.0, dirt=Dirt(seed=5), noise=0.0),
    "dirt with rests": Simulation(600, 50.0, course="rests", dirt=Dirt(seed=6), noise=0.0),
}


@pytest.mark.parametrize("name", SOUND_STREAMS)
def test_sound_recordings_keep_all_rows(name):
    """The seeds differ from those that the thresholds were tuned on."""
    samples = simulate(ROBOT, SOUND_STREAMS[name], 51)
    assert corrupt_rows(samples) == []
    assert corrupt_rows(samples.rows(slice(None, None, 2))) == []  # thinned
    short = replace(samples, episode=np.arange(len(samples), dtype=np.int64) // 5)
    assert corrupt_rows(short) == []  # episodes too short to show a course


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_unordered_samples_lose_only_absurd_rows(seed):
    """The rows are independent instants, some with torques of a heavy tail."""
    rng = np.random.default_rng(seed)
    q, dq, ddq = rng.uniform(-2, 2, (300, 2)), rng.standard_t(4, (300, 2)), rng.standard_t(4, (300, 2))
    tau = 20 * np.sin(q) + 5 * ddq + 3 * np.sign(dq)
    places = np.arange(300)
    samples = Samples(("a", "b"), places.astype(float), np.zeros(300, np.int64), q, dq, ddq, tau)
    assert corrupt_rows(samples) == []
    assert corrupt_rows(add_spikes(samples, ("tau", 9, 1, 1e12), ("tau", 40, 0, 1e5))) == [9, 40]


def test_long_recording_is_checked_in_blocks():
    samples = add_spikes(CLEAN_SAMPLES, ("tau", 109, 0, 3.0), ("tau", 110, 1, 1e12), ("tau", 250, 0, 3.0))
    found = find_in_blocks(300, lambda first, last: samples.rows(slice(first, last)), block=110)
    assert np.flatnonzero(found.rows).tolist() == [109, 110, 250]


@pytest.mark.parametrize("estimator", ["lip-chain", slow("rigid-body"), slow("auto")])
@pytest.mark.parametrize("joint", [0, 1])
def test_corrupt_row_does_not_change_the_model(estimator, joint):
    """Noise, predictions and uncertainty equal those of the recording without the row."""
    without = CLEAN_SAMPLES.rows(np.arange(300) != ROW)
    expected = lipcore.train(without, ROBOT.joint_types, estimator, QUICK_OPTIONS)
    for amount in (1e12, 50 * NOISE):
        made = lipcore.train(
            add_spikes(CLEAN_SAMPLES, ("tau", ROW, joint, amount)), ROBOT.joint_types, estimator, QUICK_OPTIONS
        )
        assert (made.fit["samples_corrupt"], made.fit["samples_given"]) == (1, 299)
        np.testing.assert_allclose(made.noise_std, expected.noise_std, rtol=1e-9)
        query = CLEAN_SAMPLES.q[:20], CLEAN_SAMPLES.dq[:20], CLEAN_SAMPLES.ddq[:20]
        for name in ("tau", "tau_std"):
            one, other = (getattr(model.predict(*query), name) for model in (made, expected))
            np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-10)

"""Tests of repeated motion, on simulated arms and against distances computed one by one."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore.data.repetition import (
    OPTIONS,
    features,
    find_period,
    group_blocks,
    measure_distinct_share,
    measure_repeated_share,
    repetition,
)
from lipcore.data.samples import Samples
from lipcore.robots.dirt import Dirt
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from lipcore.training.held_out import find_unrepeated
from tests.lipcore.arm_oracles import hold_joints

PANDA = load_robot("panda")
TYPES = ("revolute",) * 7


def motion(course="sinusoids", seed=1, rows=2000, speed=2.0, **kwargs) -> Samples:
    """Simulate a Panda at 50 Hz; periodic motion repeats every 10 s / speed."""
    return simulate(PANDA, Simulation(n_samples=rows, rate=50.0, course=course, speed=speed, **kwargs), seed)


def join_motions(*parts: Samples) -> Samples:
    """Concatenate several motions into one recording."""
    rows = sum(map(len, parts))
    arrays = {name: np.concatenate([getattr(each, name) for each in parts]) for name in ("q", "dq", "ddq", "tau")}
    return Samples(parts[0].joint_names, np.arange(rows) / 50.0, np.zeros(rows, np.int64), **arrays)


def halves(samples: Samples) -> tuple[Samples, Samples]:
    cut = len(samples) // 2
    return samples.rows(slice(0, cut - 15)), samples.rows(slice(cut + 15, None))


@pytest.mark.parametrize(
    ("course", "speed", "dirt", "period"),
    [
        ("periodic", 1.0, None, 10.0),
        ("periodic", 5.0, None, 2.0),
        ("periodic", 2.0, Dirt(), 5.0),
        ("sinusoids", 2.0, None, None),
        ("rests", 2.0, None, None),
    ],
)
def test_periodic_motion_alone_is_repeated(course: str, speed: float, dirt: Dirt | None, period: float | None) -> None:
    found = repetition(*halves(motion(course, speed=speed, dirt=dirt)), TYPES)
    assert found.is_repeated == (period is not None)
    assert found.share > 0.9 if period else found.share < 0.1
    assert found.period == (period and pytest.approx(period, rel=0.02))


@pytest.mark.slow
@pytest.mark.parametrize(("course", "passes"), [("sinusoids", 1), ("periodic", 4)])
def test_repeated_motion_counts_once(course: str, passes: int) -> None:
    """Test forty seconds (four periods) also with noise, after a rest, and as separate episodes."""
    for dirt in (None, Dirt()):
        samples = motion(course, speed=1.0, dirt=dirt)
        assert measure_distinct_share(samples, TYPES) == pytest.approx(1 / passes, rel=0.1)
    apart = replace(samples, episode=np.arange(2000) // 500)
    assert measure_distinct_share(apart, TYPES) == measure_distinct_share(samples, TYPES)
    still = samples.rows(np.zeros(500, np.int64))
    expected = (500 + 2000 / passes) / 2500
    assert measure_distinct_share(join_motions(still, samples), TYPES) == pytest.approx(expected, rel=0.1)


def test_motion_of_another_recording_is_recognised() -> None:
    training = motion("periodic", seed=1)
    assert repetition(training, motion("periodic", seed=1, rows=600), TYPES).share > 0.9
    assert repetition(training, motion("periodic", seed=2, rows=600), TYPES).share < 0.1


def test_repeated_share_matches_distances_one_by_one() -> None:
    """States are half the limit away from a known one, and the last quarter twice the limit."""
    rng = np.random.default_rng(0)
    known = np.repeat(rng.standard_normal((40, 5)), 2, axis=0)  # every other step is zero, so the minimum limit applies
    limit = OPTIONS.min_near * np.sqrt(2 * known.var(axis=0).sum())
    away = rng.standard_normal((40, 5))
    away *= limit * np.where(np.arange(40) < 30, 0.5, 2.0)[:, None] / np.linalg.norm(away, axis=1, keepdims=True)
    states = known[1::2] + away
    nearest = [min(np.linalg.norm(state - each) for each in known) for state in states]
    expected = np.mean(np.array(nearest[:30]) <= limit) * 0.75
    assert measure_repeated_share(known[1::2].repeat(3, axis=0), states) >= expected > 0.7


def test_blocks_that_repeat_each_other_form_a_group() -> None:
    one, two = (motion("periodic", seed=seed, rows=500) for seed in (1, 2))
    recording = join_motions(one, two)
    found = group_blocks(features(recording, TYPES), np.arange(0, 1001, 250))  # 5 s are a period
    assert found[0] == found[1] != found[2] == found[3]


def test_unrepeated_motion_is_held_out_instead_of_repeated_end() -> None:
    free, again = motion(seed=3, rows=600, speed=10.0), motion("periodic", rows=2000)
    ((first, last),) = find_unrepeated(join_motions(free, again), TYPES, 0.25, 0)
    assert first == 0
    assert last == pytest.approx(600, abs=250)


def test_whole_groups_of_periods_are_held_out() -> None:
    """Two motions alternate, three periods each: the last part repeats the first, the middle is new."""
    one, two = (motion("periodic", seed=seed, rows=750) for seed in (1, 2))
    assert find_unrepeated(join_motions(one, two, one), TYPES, 0.3, 0) == [(750, 1500)]


@pytest.mark.parametrize("course", ["periodic", "sinusoids"])
def test_last_part_is_held_out_by_default(course: str) -> None:
    assert find_unrepeated(motion(course), TYPES, 0.3, 0) is None


def test_episodes_count_as_blocks() -> None:
    """Two motions occur twice and two others once; the last episode repeats the first."""
    seeds = (1, 2, 3, 4, 2, 1)
    parts = [motion(seed=seed, rows=300, speed=10.0) for seed in seeds]
    recording = replace(join_motions(*parts), episode=np.repeat(np.arange(6), 300))
    found = find_unrepeated(recording, TYPES, 0.3, 0)
    held = {place for first, last in found for place in range(first // 300, last // 300)}
    assert held
    for seed in (1, 2):
        assert len({seeds.index(seed) in held, 5 - seeds[::-1].index(seed) in held}) == 1  # both on the same side


def test_motion_without_return_has_no_period() -> None:
    assert find_period(motion("rests"), TYPES) is None
    assert find_period(hold_joints(motion(rows=100), range(7), 0.0), TYPES) is None

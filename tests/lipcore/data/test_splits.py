"""Tests that splits separate episodes, stretches and moments, and are reproducible."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lipcore.data.samples import Samples
from lipcore.data.splits import GUARD_S, Split, SplitError, choose_stretches, select_rows, split

KINDS = ("episodes", "last", "blocks")


@st.composite
def recordings(draw):
    """Draw episodes and times of rows, with pauses between episodes or clocks that restart."""
    lengths = draw(st.lists(st.integers(1, 30), min_size=2, max_size=6))
    random = np.random.default_rng(draw(st.integers(0, 99)))
    episode, t, now = [], [], 0.0
    for number, length in enumerate(lengths):
        now = draw(st.sampled_from([0.0, now + 0.01, now + 0.3, now + 50.0]))
        times = now + np.cumsum(random.choice([0.01, 0.02, 0.05], length))
        episode += [number] * length
        t += times.tolist()
        now = t[-1]
    return np.array(episode), np.array(t)


splits = st.builds(
    Split,
    st.sampled_from(KINDS),
    st.floats(0.05, 0.95),
    st.integers(2, 12),
    st.sampled_from([0.0, 0.015, 0.1, GUARD_S]),
    st.integers(0, 5),
)


def courses(episode, t):
    """Return the course of time of each row, (N,), row by row."""
    found, course = [], 0
    for row in range(len(t)):
        if row and episode[row] != episode[row - 1] and t[row] <= t[row - 1]:
            course += 1
        found.append(course)
    return np.array(found)


def split_or_none(episode, t, how):
    """Return the parts, or None if one side is empty."""
    try:
        return split(episode, t, how)
    except SplitError:
        return None


@given(recordings(), splits)
def test_guard_drops_exactly_rows_near_the_other_side(recording, how):
    """Compare with all pairs of rows of opposite sides within one course of time."""
    episode, t = recording
    whole, found = split_or_none(episode, t, replace(how, guard_s=0.0)), split_or_none(episode, t, how)
    if whole is None or found is None:
        return
    assert whole.guarded == 0
    assert found.train.any()
    assert found.held_out.any()
    assert not (found.train & found.held_out).any()
    assert found.guarded == (~found.train & ~found.held_out).sum()
    course = courses(episode, t)
    for row in range(len(t)):
        other = whole.held_out if whole.train[row] else whole.train
        near = (other & (course == course[row]) & (abs(t - t[row]) <= how.guard_s)).any()
        kept = found.train[row] if whole.train[row] else found.held_out[row]
        assert kept == (not near)


@given(recordings(), splits, st.randoms(use_true_random=False))
def test_row_order_does_not_change_the_split(recording, how, random):
    episode, t = recording
    found = split_or_none(episode, t, how)
    order = list(range(len(t)))
    random.shuffle(order)
    again = split_or_none(episode[order], t[order], how)
    assert (found is None) == (again is None)
    if found is not None:
        np.testing.assert_array_equal(again.train, found.train[order])
        np.testing.assert_array_equal(again.held_out, found.held_out[order])


@given(recordings(), st.floats(0.05, 0.95), st.integers(0, 5))
def test_whole_episodes_are_on_one_side(recording, share, seed):
    episode, t = recording
    found = split_or_none(episode, t, Split("episodes", share, guard_s=0.0, seed=seed))
    assert found is not None
    for number in np.unique(episode):
        assert len(set(found.held_out[episode == number])) == 1


@given(recordings(), st.floats(0.05, 0.95))
def test_last_rows_come_after_all_others(recording, share):
    found = split_or_none(*recording, Split("last", share, guard_s=0.0))
    assert found is not None
    first = np.flatnonzero(found.held_out)[0]
    assert found.held_out[first:].all()
    assert abs(found.held_out.sum() - share * len(found.held_out)) <= 1


@given(st.integers(20, 300), st.integers(2, 20), st.floats(0.05, 0.95), st.integers(0, 9))
def test_blocks_are_stretches_of_equal_length(rows, blocks, share, seed):
    """Without a guard, each held-out stretch is a whole number of blocks long."""
    t = np.arange(rows) / 100
    found = split(np.zeros(rows, dtype=np.int64), t, Split("blocks", share, blocks, 0.0, seed))
    edges = np.flatnonzero(np.diff(np.concatenate([[0], found.held_out, [0]])))
    lengths = edges[1::2] - edges[::2]
    for length in lengths:
        count = round(length * blocks / rows)
        assert count >= 1
        assert abs(length - count * rows / blocks) <= 1
    wanted = min(max(share * blocks, 1), blocks - 1)
    assert abs(found.held_out.sum() * blocks / rows - wanted) <= 0.5 + blocks**2 / rows


@given(st.lists(st.integers(1, 1000), min_size=2, max_size=50), st.floats(0.01, 0.99), st.integers(0, 3))
def test_chosen_stretches_are_close_to_the_share(lengths, share, seed):
    counts = np.array(lengths)
    chosen = choose_stretches(counts, share, seed)
    assert chosen.any()
    assert not chosen.all()
    held, wanted = counts[chosen].sum(), share * counts.sum()
    assert abs(held - wanted) <= max(counts.max(), wanted - counts[chosen].sum())
    if chosen.sum() > 1 and held > wanted:  # each choice reduced the distance to the share
        assert held - wanted < counts[chosen].max()


def test_splits_stay_the_same_in_later_releases():
    """Lineages depend on these numbers: never change them."""
    chosen = choose_stretches(np.array([10, 20, 30, 40, 50, 60]), 0.3, 7)
    assert np.flatnonzero(chosen).tolist() == [0, 2, 3]
    assert len({choose_stretches(np.full(20, 50), 0.3, seed).tobytes() for seed in range(20)}) > 10


def test_guard_ends_at_pauses_and_clock_restarts():
    t = np.arange(10) / 10
    episode = np.repeat([0, 1], 10)
    how = Split("last", 0.5, guard_s=0.25)
    assert split(episode, np.concatenate([t, t + 1.0]), how).guarded == 4  # two steps on each side
    assert split(episode, np.concatenate([t, t + 1.2]), how).guarded == 0
    assert split(episode, np.concatenate([t, t]), how).guarded == 0


def split_rows(rows, how):
    """Split one episode at 100 Hz."""
    return split(np.zeros(rows, dtype=np.int64), np.arange(rows) / 100, how)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: split_rows(50, Split("episodes")), "episodes is 1, expected at least 2"),
        (
            lambda: split_rows(50, Split("blocks", blocks=51)),
            "blocks is 51, expected at most the number of rows, 50",
        ),
        (
            lambda: split_rows(50, Split("last", guard_s=10.0)),
            "guard_s is 10.0, expected a smaller value: all rows held out are closer",
        ),
        (lambda: split_rows(50, Split("last", 0.99, guard_s=0.02)), "all rows to train on are closer than that"),
        (lambda: split_rows(1, Split("last")), "rows is 1, expected at least 2"),
        (lambda: Split("rows"), "kind is 'rows', expected one of episodes, last, blocks"),
        (lambda: Split(share=1.0), "share is 1.0"),
        (lambda: Split(share=float("nan")), "share is nan"),
        (lambda: Split(blocks=1), "blocks is 1"),
        (lambda: Split(guard_s=float("inf")), "guard_s is inf"),
    ],
)
def test_impossible_splits_are_explained(make, message):
    with pytest.raises(SplitError, match=message):
        make()


@pytest.mark.parametrize(("t", "message"), [([0.0] * 4, "t has shape"), ([0.0, np.nan, 1.0], "not finite")])
def test_invalid_times_are_rejected(t, message):
    with pytest.raises(ValueError, match=message):
        split(np.zeros(3, dtype=np.int64), np.array(t), Split())


def test_selected_rows_start_an_episode_after_each_gap():
    rows = np.arange(24.0).reshape(12, 2)
    episode = np.repeat([3, 5], 6)
    samples = Samples(("a", "b"), np.arange(12.0), episode, rows, rows + 1, rows + 2, rows + 3)
    kept = np.array([1, 1, 0, 0, 1, 1, 1, 0, 1, 1, 1, 1], dtype=bool)
    found = select_rows(samples, kept)
    assert found.episode.tolist() == [0, 0, 1, 1, 2, 3, 3, 3, 3]
    np.testing.assert_array_equal(found.tau, samples.tau[kept])
    np.testing.assert_array_equal(found.t, samples.t[kept])
    assert len(select_rows(samples, np.zeros(12, dtype=bool))) == 0

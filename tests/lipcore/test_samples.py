"""The table of samples."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from lipcore.data.samples import Samples


def table(rows: int = 6, episode: tuple[int, ...] | None = None, names: tuple[str, ...] = ("a", "b")) -> Samples:
    values = np.arange(4.0 * rows * len(names)).reshape(4, rows, len(names))
    numbers = np.array(episode if episode is not None else [0] * rows, dtype=np.int64)
    return Samples(names, np.arange(rows) / 10, numbers, *values)


@pytest.mark.parametrize("name", ["q", "dq", "ddq", "tau"])
def test_array_of_another_shape_is_named(name: str) -> None:
    with pytest.raises(ValueError, match=rf"^{name} has shape \(6, 3\), expected \(6, 2\)"):
        replace(table(), **{name: np.zeros((6, 3))})


def test_episode_of_another_length_is_named() -> None:
    with pytest.raises(ValueError, match=re.escape("episode has shape (5,), expected (6,)")):
        replace(table(), episode=np.zeros(5, dtype=np.int64))


def test_rows_are_chosen_from_every_column() -> None:
    samples = table()
    for index in (slice(1, 5, 2), np.array([1, 3]), np.isin(np.arange(6), [1, 3])):
        part = samples.rows(index)
        assert part.joint_names == samples.joint_names
        assert part.t.tolist() == [0.1, 0.3]
        assert part.tau.tolist() == samples.tau[[1, 3]].tolist()
        assert len(part.episode) == 2


def test_episodes_are_contiguous_runs() -> None:
    assert table(6, (4, 4, 1, 1, 1, 4)).episodes() == [slice(0, 2), slice(2, 5), slice(5, 6)]
    assert table(0).episodes() == []


def test_concatenation_keeps_rows_in_order_and_episodes_apart() -> None:
    joined = Samples.concatenate([table(3, (7, 7, 9)), table(2, (7, 7)), table(1, (0,))])
    assert joined.episode.tolist() == [0, 0, 1, 2, 2, 3]
    assert np.array_equal(joined.q, np.concatenate([table(3).q, table(2).q, table(1).q]))
    assert len(joined.episodes()) == 4


def test_concatenation_of_other_joints_or_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match=r"joint names differ: \['a', 'c'\]"):
        Samples.concatenate([table(), table(names=("a", "c"))])
    with pytest.raises(ValueError, match="no samples"):
        Samples.concatenate([])


def test_tensors_are_copies_in_float64() -> None:
    samples = table()
    tau, motion = samples.torque(), samples.motion()
    assert str(tau.dtype) == "torch.float64"
    before = samples.tau.copy()
    tau.zero_()
    motion.q.zero_()
    assert np.array_equal(samples.tau, before)
    assert samples.q[-1, -1] != 0

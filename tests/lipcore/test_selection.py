"""Choosing samples that lie far from each other."""

from __future__ import annotations

import numpy as np
import torch

from lipcore.data.motion import Motion
from lipcore.posterior.selection import spread_out


def random_motion(size: int, seed: int = 0) -> Motion:
    return Motion.from_arrays(*np.random.default_rng(seed).normal(size=(3, size, 3)))


def test_all_samples_are_taken_where_there_are_no_more() -> None:
    assert spread_out(random_motion(5), 5).tolist() == [0, 1, 2, 3, 4]
    assert spread_out(random_motion(5), 9).tolist() == [0, 1, 2, 3, 4]


def test_choice_is_sorted_without_repeats_and_repeatable() -> None:
    chosen = spread_out(random_motion(200), 40)
    assert chosen.tolist() == sorted(set(chosen.tolist()))
    assert len(chosen) == 40
    assert torch.equal(chosen, spread_out(random_motion(200), 40))


def test_no_sample_is_taken_twice_where_samples_repeat() -> None:
    motion = random_motion(3)[torch.arange(60) % 3]  # a robot that holds three postures
    chosen = spread_out(motion, 10)
    assert len(set(chosen.tolist())) == 10


def test_rare_regions_of_position_speed_and_acceleration_are_represented() -> None:
    rng = np.random.default_rng(1)
    q, dq, ddq = 0.05 * rng.normal(size=(3, 500, 3))
    q[17, 0], dq[171, 1], ddq[333, 2] = 2.5, 4.0, -9.0
    chosen = spread_out(Motion.from_arrays(q, dq, ddq), 10).tolist()
    assert {17, 171, 333} <= set(chosen)


def test_choice_covers_the_motion_better_than_every_so_manieth_sample() -> None:
    motion = random_motion(400, seed=2)

    def largest_gap(rows: torch.Tensor) -> float:
        points = torch.cat([motion.q, motion.dq, motion.ddq], dim=1)
        return float(torch.cdist(points, points[rows]).amin(1).max())

    assert largest_gap(spread_out(motion, 40)) < largest_gap(torch.arange(0, 400, 10))

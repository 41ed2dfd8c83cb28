"""The floor of the stated uncertainty: what errors prove, and nothing that chance explains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lipcore.online.record import Record, error_floor
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Payload, Stream, inverse_dynamics, simulate

NOISE = np.array([0.05, 2.0])


def record(error: np.ndarray, noise_std: np.ndarray = NOISE) -> Record:
    return Record.of(error, np.zeros_like(error), np.zeros_like(error), noise_std)


def test_excess_beyond_noise_is_the_floor() -> None:
    rng = np.random.default_rng(0)
    function = np.array([0.3, 0.0])
    floor = error_floor(record(np.hypot(function, NOISE) * rng.standard_normal((2000, 2))))
    assert floor[0] == pytest.approx(0.3**2, rel=0.15)
    assert floor[1] == 0.0


def test_floor_and_noise_together_are_the_error_seen() -> None:
    errors = np.full((50, 2), [0.2, 2.0])
    floor = error_floor(record(errors))
    assert floor[0] + NOISE[0] ** 2 == pytest.approx(0.04)
    assert floor[1] == 0.0  # no larger than the noise is


@pytest.mark.parametrize("rows", [50, 200, 2000])
def test_noise_alone_raises_it_for_less_than_one_record_in_a_hundred(rows: int) -> None:
    rng = np.random.default_rng(rows)
    floors = np.array([error_floor(record(NOISE * rng.standard_normal((rows, 2)))) for _ in range(1500)])
    assert 0 < (floors > 0).mean() < 0.008
    assert (floors <= 6 * np.sqrt(2 / rows) * NOISE**2).all()


def test_few_rows_prove_nothing() -> None:
    assert error_floor(record(np.full((49, 2), 100.0))).tolist() == [0.0, 0.0]
    assert (error_floor(record(np.full((50, 2), 100.0))) > 9000).all()
    assert error_floor(Record.empty(2)).tolist() == [0.0, 0.0]


def test_payload_on_a_panda_widens_to_its_own_torque() -> None:
    robot = load_robot("panda")
    stream = Stream(n_samples=200, rate=100, speed=5, noise=0.05, payload=Payload(1.0))
    loaded = simulate(robot, stream, seed=0)
    clean = simulate(robot, replace(stream, noise=0.0), seed=0).tau
    mean = inverse_dynamics(robot, loaded.q, loaded.dq, loaded.ddq)
    floor = error_floor(Record.of(loaded.tau, mean, np.full_like(mean, 1e-3), np.full(7, 0.05)))
    weight = ((clean - mean) ** 2).mean(axis=0)
    heavy = weight > 0.05
    assert heavy.sum() >= 4
    assert np.allclose(floor[heavy], weight[heavy], rtol=0.1)

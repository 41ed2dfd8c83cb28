"""Tests of dirty streams: friction of the drives, noise, encoder counts, rests and repetition."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from lipcore.robots.dirt import (
    MAXWELL_ELEMENTS,
    MIN_SIMULATION_HZ,
    SCALED_AMOUNTS,
    Dirt,
    DriveModel,
    draw_coloured_noise,
    simulate_lugre,
    simulate_play,
)
from lipcore.robots.library import Robot, load_robot
from lipcore.robots.simulation import FAST_SPEED, PERIOD_S, Course, Simulation, simulate, usual_torque
from tests.lipcore.robots.test_simulation import assert_derivatives_match

NO_DIRT = replace(Dirt().scaled(0.0), motion_hz=400.0)
FINE_STREAM = Simulation(n_samples=2000, rate=MIN_SIMULATION_HZ, speed=FAST_SPEED, noise=0.0)
ELASTIC_OR_NOT: tuple[DriveModel, ...] = ("lugre", "elastic")
TORQUES = [
    [2.2874694178468293, 1.02798221573284],
    [2.400955250378086, 1.0497709869450045],
    [2.175389153091892, 0.9843588813493938],
    [1.723263224226527, 0.9170993732036267],
    [1.1382779952245266, 0.8914957025954249],
]


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot("double-pendulum")


def friction(t: np.ndarray, dq: np.ndarray, coulomb: float = 2.0, breaks: float = 3.0) -> np.ndarray:
    column = np.ones((len(t), 1))
    return simulate_lugre(t, dq[:, None], coulomb * column, breaks * column, 0.004, 0.05)[:, 0]


def test_friction_solves_its_differential_equation() -> None:
    coulomb, breaks, breakaway, slow = 2.0, 3.0, 0.004, 0.05
    stiffness = breaks / breakaway

    def speed(t: float) -> float:
        return 0.2 * np.sin(3 * t) * np.cos(0.7 * t)

    def bristle(t: float, z: np.ndarray) -> np.ndarray:
        g = coulomb + (breaks - coulomb) * np.exp(-((speed(t) / slow) ** 2))
        return np.asarray(speed(t) - stiffness * abs(speed(t)) * z / g)

    t = np.arange(0, 4, 2e-4)
    expected = stiffness * solve_ivp(bristle, (0, 4), [0.0], "LSODA", t, rtol=1e-9, atol=1e-12).y[0]
    assert np.abs(friction(t, np.array([speed(each) for each in t])) - expected).max() < 0.02 * breaks


def test_friction_is_coulomb_when_sliding_and_spring_when_stuck() -> None:
    t = np.arange(0, 2, 1e-3)
    assert friction(t, np.full(len(t), 0.5))[-1] == pytest.approx(2.0, rel=1e-6)  # far above the Stribeck speed
    assert friction(10 * t, np.full(len(t), -3e-3))[-1] == pytest.approx(-3.0, rel=3e-3)  # far below
    moved = 1e-5 * (1 - np.cos(5 * t))
    spring = friction(t, np.gradient(moved, t))
    np.testing.assert_allclose(spring, 3.0 / 0.004 * moved, atol=0.01 * np.abs(spring).max())
    stopped = friction(t, np.where(t < 1, 0.5, 0.0))
    np.testing.assert_allclose(stopped[t >= 1], 2.0, rtol=1e-6)  # a joint at rest keeps its torque


def test_zero_dirt_only_derives_motion_from_positions(robot: Robot) -> None:
    clean, made = (simulate(robot, replace(FINE_STREAM, dirt=dirt), 1) for dirt in (None, NO_DIRT))
    np.testing.assert_array_equal(made.q, clean.q)
    np.testing.assert_allclose(made.tau, clean.tau, rtol=0, atol=1e-12 * np.abs(clean.tau).max())
    inner = slice(50, -50)  # filters are less accurate at the ends
    for name in ("dq", "ddq"):
        exact = getattr(clean, name)
        np.testing.assert_allclose(getattr(made, name)[inner], exact[inner], atol=0.01 * np.abs(exact).max())


@pytest.mark.parametrize("part", [name for name in SCALED_AMOUNTS if name not in ("encoder", "spring")])
def test_every_part_changes_the_torque(robot: Robot, part: str) -> None:
    friction = part in ("stiction", "load", "position", "warmth")  # parts of friction
    without = replace(NO_DIRT, friction=0.3) if friction else NO_DIRT
    without = replace(without, viscous=0.3) if part == "viscous_warmth" else without
    dirts = without, replace(without, **{part: 0.3})
    less, more = (simulate(robot, replace(FINE_STREAM, dirt=dirt), 1).tau for dirt in dirts)
    added = np.std(more - less) / np.std(less)
    assert 0.005 < added < 1.0


def test_friction_of_a_seed_never_changes(robot: Robot) -> None:
    """Compare with torques from before there were other drives."""
    made = simulate(robot, Simulation(5, 50.0, speed=FAST_SPEED, dirt=Dirt(seed=3)), 4)
    np.testing.assert_allclose(made.tau, TORQUES, rtol=1e-9)


def test_maxwell_drive_has_the_friction_of_its_coefficients(robot: Robot) -> None:
    dirt = replace(NO_DIRT, friction=0.3, viscous=0.2, load=0.2, stiction=0.4, drive="maxwell")
    clean, made = (simulate(robot, replace(FINE_STREAM, dirt=each), 1) for each in (NO_DIRT, dirt))
    known = dirt.coefficients(usual_torque(robot))
    exact = simulate(robot, FINE_STREAM, 1)  # without the low-pass of the velocities
    sign = np.tanh(exact.dq / 0.02)
    expected = known.viscous * exact.dq + (known.coulomb + known.load * np.abs(clean.tau)) * sign
    for (width, _), torque in zip(MAXWELL_ELEMENTS, known.elements, strict=True):
        deflection = np.zeros(2)
        for k, step in enumerate(np.diff(exact.q, axis=0, prepend=exact.q[:1]) / width):
            deflection = np.clip(deflection + step, -1, 1)
            expected[k] += torque * deflection
    np.testing.assert_allclose(made.tau - clean.tau, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_play_is_spring_until_it_slips() -> None:
    q = 0.02 * np.array([[0.0], [0.3], [1.0], [2.5], [2.0], [0.5], [0.0]])
    np.testing.assert_allclose(simulate_play(q, 0.02)[:, 0], [0, 0.3, 1, 1, 0.5, -1, -1], atol=1e-12)


def test_elastic_drive_measures_motors_behind_springs(robot: Robot) -> None:
    stiff, soft = (replace(NO_DIRT, drive="elastic", spring=spring) for spring in (0.0, 0.01))
    joints, motors = (simulate(robot, replace(FINE_STREAM, dirt=dirt), 1) for dirt in (stiff, soft))
    np.testing.assert_array_equal(motors.tau, joints.tau)  # the spring carries the torque of the bodies
    stretch, torque = motors.q - joints.q, joints.tau / usual_torque(robot)
    ratio = (stretch * torque).sum(axis=0) / (torque**2).sum(axis=0)
    assert ((ratio >= 0.005) & (ratio <= 0.015)).all()
    np.testing.assert_allclose(stretch, ratio * torque, atol=1e-12)
    assert_derivatives_match(motors, 0.02)
    lugre, elastic = (
        simulate(robot, replace(FINE_STREAM, dirt=replace(NO_DIRT, friction=0.3, spring=0.01, drive=drive)), 1).tau
        for drive in ELASTIC_OR_NOT
    )
    assert np.abs(elastic - lugre).max() > 0.05 * np.abs(lugre).max()  # the motor turns back at another time


def test_viscous_torque_falls_while_the_joint_warms_up(robot: Robot) -> None:
    cold = replace(NO_DIRT, viscous=0.2, viscous_warmth=0.5, warm_s=1.0)
    clean, warm, warming = (
        simulate(robot, replace(FINE_STREAM, dirt=dirt), 1).tau
        for dirt in (NO_DIRT, replace(cold, viscous_warmth=0.0), cold)
    )
    t = np.arange(len(clean)) / FINE_STREAM.rate
    excess = ((warming - clean) / (warm - clean) - 1) / np.exp(-t)[:, None]
    np.testing.assert_allclose(excess, excess[:1] + 0 * excess, rtol=1e-6)
    assert ((excess >= 0.25) & (excess <= 0.75)).all()


def test_positions_are_counts_at_any_rate(robot: Robot) -> None:
    stream = Simulation(n_samples=50, rate=25.0, speed=FAST_SPEED, dirt=Dirt(encoder=1e-3))
    made = simulate(robot, stream, 2)
    np.testing.assert_allclose(made.q / 1e-3, np.round(made.q / 1e-3), atol=1e-6)
    np.testing.assert_allclose(np.diff(made.t), 0.04)
    assert made.tau.flags.c_contiguous
    assert np.array_equal(made.tau, simulate(robot, stream, 2).tau)


def test_noise_has_its_deviation_and_spectrum() -> None:
    made = draw_coloured_noise(np.random.default_rng(0), (200_000, 2), 1e-3, 20.0)
    assert made.std() == pytest.approx(1.0, abs=0.03)
    for lag in (1, 8, 20):
        expected = np.exp(-2 * np.pi * 20.0 * lag * 1e-3)
        assert np.mean(made[lag:] * made[:-lag]) == pytest.approx(expected, abs=0.03)


def test_periodic_motion_repeats_and_rests_occur(robot: Robot) -> None:
    again = simulate(robot, replace(FINE_STREAM, n_samples=3000, course="periodic"), 3)
    period = round(PERIOD_S / FAST_SPEED * MIN_SIMULATION_HZ)
    np.testing.assert_allclose(again.q[period:], again.q[:-period], atol=1e-9)
    stops = simulate(robot, replace(FINE_STREAM, n_samples=20_000, course="rests", speed=1.0), 3)
    assert 0.2 < np.mean(np.abs(stops.dq).max(1) < 1e-9) < 0.7
    courses: tuple[Course, ...] = ("periodic", "rests")
    for course in courses:
        assert_derivatives_match(simulate(robot, replace(FINE_STREAM, course=course), 3), 0.02)


def test_invalid_dirt_is_rejected(robot: Robot) -> None:
    with pytest.raises(ValueError, match="friction of the dirt is -1, expected a number of at least 0"):
        Dirt(friction=-1)
    with pytest.raises(ValueError, match="warm_s of the dirt is 0, expected a positive number"):
        Dirt(warm_s=0)
    with pytest.raises(ValueError, match="drive is 'worm', expected one of lugre, maxwell, elastic"):
        Dirt(drive="worm")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="course is 'circles', expected one of sinusoids, periodic, rests"):
        simulate(robot, Simulation(course="circles"), 0)  # type: ignore[arg-type]

"""Tests of simulated robots: joints, motion and torque against Pinocchio."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from benchmarks.arms import another_unit
from lipcore.data.samples import Samples
from lipcore.robots.library import ROBOTS, Robot, load_robot
from lipcore.robots.simulation import Payload, Simulation, simulate


@pytest.fixture(scope="module")
def panda() -> Robot:
    return load_robot("panda")


def rnea(robot: Robot, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    """Return the torque at each instant; the configuration is integrated from neutral for unbounded joints."""
    data, neutral = robot.model.createData(), pin.neutral(robot.model)
    rows = zip(q, dq, ddq, strict=True)
    return np.array([pin.rnea(robot.model, data, pin.integrate(robot.model, neutral, x), v, a) for x, v, a in rows])


@pytest.mark.parametrize("name", ROBOTS)
def test_simulated_torque_matches_pinocchio(name: str) -> None:
    robot = load_robot(name)
    count = len(ROBOTS[name].free)
    assert robot.joint_names == ROBOTS[name].free
    assert robot.joint_types == ("prismatic" if name == "tiago" else "revolute", *("revolute",) * (count - 1))
    samples = simulate(robot, Simulation(n_samples=20, motion="full", speed=10, noise=0.0), seed=1)
    assert samples.tau.shape == (20, count)
    assert samples.joint_names == robot.joint_names
    expected = rnea(robot, samples.q, samples.dq, samples.ddq)
    assert np.allclose(samples.tau, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    assert np.abs(samples.tau).max() > 1e-4


def test_equal_seeds_give_equal_samples(panda: Robot) -> None:
    one, same, other = (simulate(panda, Simulation(n_samples=30), seed) for seed in (3, 3, 4))
    for name in ("t", "q", "dq", "ddq", "tau"):
        assert np.array_equal(getattr(one, name), getattr(same, name))
    for name in ("q", "dq", "ddq", "tau"):
        assert not np.allclose(getattr(one, name), getattr(other, name))


def assert_derivatives_match(samples: Samples, share: float) -> None:
    """Compare velocity and acceleration with central differences. share: tolerance, of the largest derivative."""
    for signal, derivative in ((samples.q, samples.dq), (samples.dq, samples.ddq)):
        error = np.gradient(signal, samples.t[1] - samples.t[0], axis=0)[1:-1] - derivative[1:-1]
        assert np.abs(error).max() < share * np.abs(derivative).max()


def test_velocity_and_acceleration_are_derivatives_of_position(panda: Robot) -> None:
    fine = simulate(panda, Simulation(n_samples=3000, rate=1000.0, speed=10), seed=0)
    assert np.allclose(np.diff(fine.t), 1e-3)
    assert_derivatives_match(fine, 1e-4)


@pytest.mark.parametrize("motion", ["middle", "full"])
@pytest.mark.parametrize("name", ["panda", "kinova", "tiago"])
def test_motion_spans_its_range_unless_speed_limits_it(name: str, motion: str) -> None:
    robot = load_robot(name)
    samples, half = simulate(robot, Simulation(motion=motion, speed=10), seed=2), (robot.upper - robot.lower) / 2
    reach = np.minimum(0.5, half) if motion == "middle" else 0.95 * half
    away, speed = np.abs(samples.q - (robot.lower + robot.upper) / 2).max(0), np.abs(samples.dq).max(0)
    assert (away <= reach * (1 + 1e-9)).all()
    assert (speed <= robot.speed * (1 + 1e-9)).all()
    assert (np.isclose(away, reach) | np.isclose(speed, robot.speed)).all()


def test_friction_and_noise_are_added_as_stated(panda: Robot) -> None:
    plain = Simulation(n_samples=400, speed=10, noise=0.0)
    viscous, coulomb = np.linspace(0.1, 0.7, 7), 0.3
    clean = simulate(panda, plain, seed=5)
    rubbing = simulate(panda, replace(plain, viscous=tuple(viscous), coulomb=coulomb), seed=5)
    assert np.array_equal(rubbing.q, clean.q)
    expected = clean.tau + viscous * clean.dq + coulomb * np.sign(clean.dq)
    assert np.allclose(rubbing.tau, expected, rtol=0, atol=1e-12)

    noisy = simulate(panda, replace(plain, noise=0.2), seed=5)
    assert np.array_equal(noisy.q, clean.q)
    assert np.std(noisy.tau - clean.tau) == pytest.approx(0.2, rel=0.05)


def test_another_unit_has_other_masses(panda: Robot) -> None:
    unit, again = (another_unit(panda, 0.1, seed=3) for _ in range(2))
    for joint in range(1, panda.model.njoints):
        old, new = (each.model.inertias[joint] for each in (panda, unit))
        share = new.mass / old.mass
        assert 0.9 <= share <= 1.1
        assert share != 1
        np.testing.assert_allclose(new.lever, old.lever)
        np.testing.assert_allclose(new.inertia, share * old.inertia)
        assert again.model.inertias[joint].mass == new.mass
        assert unit.model.jointPlacements[joint] == panda.model.jointPlacements[joint]


def test_payload_adds_its_weight(panda: Robot) -> None:
    """The extra torque lifts the mass: Jᵀ m (a − g) at its point."""
    payload = Payload(mass=1.5, at=0.35, offset=(0.0, 0.03, 0.1))
    stream = Simulation(n_samples=10, speed=10, noise=0.0)
    free, loaded = simulate(panda, stream, seed=7), simulate(panda, replace(stream, payload=payload), seed=7)
    assert np.array_equal(loaded.tau[:4], free.tau[:4])
    model = panda.model.copy()
    place = pin.SE3(np.eye(3), np.array(payload.offset))
    frame = model.addFrame(pin.Frame("load", 7, 0, place, pin.FrameType.OP_FRAME))
    data = model.createData()
    for k in range(4, 10):
        pin.computeAllTerms(model, data, free.q[k], free.dq[k])
        jacobian = pin.computeFrameJacobian(model, data, free.q[k], frame, pin.LOCAL_WORLD_ALIGNED)[:3]
        pin.forwardKinematics(model, data, free.q[k], free.dq[k], free.ddq[k])
        acceleration = pin.getFrameClassicalAcceleration(model, data, frame, pin.LOCAL_WORLD_ALIGNED).linear
        force = payload.mass * (acceleration - model.gravity.linear)
        assert np.allclose(loaded.tau[k] - free.tau[k], jacobian.T @ force, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"n_samples": 1}, "n_samples"),
        ({"n_sinusoids": 0}, "n_sinusoids"),
        ({"rate": 0.0}, "rate"),
        ({"speed": float("inf")}, "speed"),
        ({"noise": -0.1}, "noise"),
        ({"motion": "wild"}, "motion"),
        ({"viscous": -1.0}, "viscous"),
        ({"viscous": (1.0, 2.0)}, "viscous"),
        ({"coulomb": float("nan")}, "coulomb"),
        ({"payload": Payload(mass=-1.0)}, "payload mass"),
        ({"payload": Payload(mass=float("inf"))}, "payload mass"),
    ],
    ids=str,
)
def test_invalid_simulation_names_the_field(panda: Robot, changes: dict, field: str) -> None:
    with pytest.raises(ValueError, match=f"^{field} "):
        simulate(panda, replace(Simulation(n_samples=5), **changes), seed=0)

"""Recordings of robots simulated by Pinocchio, with motion, noise, friction, a payload and imperfections to choose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lipcore.data.samples import Array, Samples
from lipcore.robots.dirt import MIN_SIMULATION_HZ, Dirt
from lipcore.robots.library import Robot, pinocchio

MotionRange = Literal["middle", "full"]
Course = Literal["sinusoids", "periodic", "rests"]

FUNDAMENTAL_RAD_S = 0.02
"""Fundamental frequency ω_f of eq. 16 of TR2023-063, rad/s."""
MIDDLE_AMPLITUDE = 0.5
"""Half range of a joint under `middle` motion, rad (m)."""
PERIOD_S = 10.0
"""Period of periodic motion at speed 1, s."""
FAST_SPEED = 10.0
"""`speed` of the faster variant: the same sums of sinusoids at ten times the frequency."""


@dataclass(frozen=True)
class Payload:
    """A point mass (kg) fixed to the last link from time `at` (s) on; offset (x, y, z) in m in the link's frame."""

    mass: float
    at: float = 0.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.1)


@dataclass(frozen=True)
class Simulation:
    """What to simulate. Defaults are the paper's training set; its test sets have n_sinusoids = 100."""

    n_samples: int = 500
    rate: float = 10.0
    """Hz."""
    n_sinusoids: int = 50
    motion: MotionRange = "middle"
    speed: float = 1.0
    """Factor on the fundamental frequency, and divisor of the period or of the time of a move."""
    noise: float = 0.01
    """Standard deviation of the measured torque, N·m (N)."""
    viscous: float | Sequence[float] = 0.0
    """N·m·s/rad (N·s/m), one number for all joints or one a joint."""
    coulomb: float | Sequence[float] = 0.0
    """N·m (N), one number for all joints or one a joint."""
    payload: Payload | None = None
    course: Course = "sinusoids"
    """`sinusoids`: the paper's; `periodic`: few sinusoids that repeat; `rests`: moves between points, with rests."""
    dirt: Dirt | None = None
    """Imperfections of real arms, also of q, dq and ddq, None for a perfect arm."""


def simulate(robot: Robot, simulation: Simulation, seed: int) -> Samples:
    """Return the samples of a robot that moves along its course, with its measured torque.

    Equal arguments return equal samples. Raise ValueError for a simulation that is impossible.
    """
    _check(simulation)
    rng = np.random.default_rng(seed)
    fine = 1 if simulation.dirt is None else int(np.ceil(MIN_SIMULATION_HZ / simulation.rate))
    t = np.arange(simulation.n_samples * fine) / (simulation.rate * fine)
    q, dq, ddq = COURSES[simulation.course](robot, simulation, t, rng)
    tau = inverse_dynamics(robot, q, dq, ddq, _payload_mask(simulation, t), simulation.payload)
    tau += _per_joint("viscous", simulation.viscous, robot) * dq + _per_joint(
        "coulomb", simulation.coulomb, robot
    ) * np.sign(dq)
    if simulation.dirt is not None:
        usual = usual_torque(robot)
        q, dq = simulation.dirt.motor_side(t, q, dq, tau, usual)
        tau = simulation.dirt.torque(t, q, dq, tau, usual, rng)
        q, dq, ddq = simulation.dirt.motion(t, q)
    t, q, dq, ddq, tau = (np.ascontiguousarray(values[::fine]) for values in (t, q, dq, ddq, tau))
    tau = tau + simulation.noise * rng.standard_normal(tau.shape)
    return Samples(robot.joint_names, t, np.zeros(len(t), dtype=np.int64), q, dq, ddq, tau)


def usual_torque(robot: Robot) -> Array:
    """Return the usual torque of each joint, (n,) N·m (N): its standard deviation over one fast recording.

    It is at least a tenth of the largest, because a joint about a vertical axis has friction, too.
    """
    motion = sinusoids(robot, Simulation(speed=FAST_SPEED), np.arange(100) / 10.0, np.random.default_rng(0))
    spread = inverse_dynamics(robot, *motion).std(0)
    return np.asarray(np.maximum(spread, 0.1 * spread.max()))


def inverse_dynamics(
    robot: Robot, q: Array, dq: Array, ddq: Array, loaded: Array | None = None, payload: Payload | None = None
) -> Array:
    """Return rigid-body torque (N, n) by Pinocchio's recursive Newton–Euler.

    q, dq, ddq: (N, n), SI; loaded: (N,), nonzero in rows with the payload. Raise MissingExtraError.
    """
    pin = pinocchio()
    model, with_payload = robot.model, robot.model
    if payload is not None:
        with_payload = robot.model.copy()
        mass = pin.Inertia(payload.mass, np.array(payload.offset), np.zeros((3, 3)))
        with_payload.inertias[with_payload.njoints - 1] += mass
    free, full = model.createData(), with_payload.createData()
    out = np.empty_like(q)
    for k in range(len(q)):
        use, data = (with_payload, full) if loaded is not None and loaded[k] else (model, free)
        out[k] = pin.rnea(use, data, robot.configuration(q[k]), dq[k], ddq[k])
    return out


def sinusoids(robot: Robot, simulation: Simulation, t: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Return random sums of sinusoids within the joint's range and speed: q, dq, ddq, each (N, n).

    Eq. 16 of TR2023-063. t: (N,) s; rng: of the amplitudes.
    """
    return _summed(robot, simulation, t, rng, FUNDAMENTAL_RAD_S * simulation.speed, simulation.n_sinusoids)


def periodic(robot: Robot, simulation: Simulation, t: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Return sums of five sinusoids that repeat every PERIOD_S / speed seconds: q, dq, ddq, each (N, n)."""
    return _summed(robot, simulation, t, rng, 2 * np.pi * simulation.speed / PERIOD_S, 5)


def _summed(
    robot: Robot, simulation: Simulation, t: Array, rng: np.random.Generator, fundamental: float, count: int
) -> tuple[Array, Array, Array]:
    """Return random sums of sinusoids: `count` multiples of the fundamental, rad/s."""
    omega = fundamental * np.arange(1, count + 1)
    a, b = rng.uniform(-1, 1, (2, count, robot.n_joints))
    sin, cos = np.sin(np.outer(t, omega)), np.cos(np.outer(t, omega))
    q = sin @ (a / omega[:, None]) - cos @ (b / omega[:, None])
    dq = cos @ a + sin @ b
    ddq = -sin @ (a * omega[:, None]) + cos @ (b * omega[:, None])
    return _within(robot, simulation, q, dq, ddq)


def rests(robot: Robot, simulation: Simulation, t: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Return minimum-jerk moves between random points, with rests between them: q, dq, ddq, each (N, n).

    After the share s of its time a move has covered the share 10 s³ − 15 s⁴ + 6 s⁵ of its way (Flash & Hogan 1985).
    """
    q, dq, ddq = np.zeros((3, len(t), robot.n_joints))
    begin, here = 0.0, rng.uniform(-1, 1, robot.n_joints)
    while begin <= t[-1]:
        there = rng.uniform(-1, 1, robot.n_joints)
        move, rest = rng.uniform(1.0, 2.5) / simulation.speed, rng.uniform(0.5, 2.0)
        rows = (t >= begin) & (t < begin + move + rest)
        s = np.minimum((t[rows] - begin) / move, 1.0)[:, None]
        way = there - here
        q[rows] = here + way * s**3 * (10 - 15 * s + 6 * s**2)
        dq[rows] = way * 30 * s**2 * (1 - s) ** 2 / move
        ddq[rows] = way * 60 * s * (1 - s) * (1 - 2 * s) / move**2
        begin, here = begin + move + rest, there
    return _within(robot, simulation, q, dq, ddq)


COURSES = {"sinusoids": sinusoids, "periodic": periodic, "rests": rests}


def _within(robot: Robot, simulation: Simulation, q: Array, dq: Array, ddq: Array) -> tuple[Array, Array, Array]:
    """Return the same motion within the joints' range and speed."""
    half = (robot.upper - robot.lower) / 2
    reach = np.minimum(MIDDLE_AMPLITUDE, half) if simulation.motion == "middle" else 0.95 * half
    top, bottom = q.max(0), q.min(0)
    scale = np.minimum(2 * reach / np.maximum(top - bottom, 1e-9), robot.speed / np.maximum(np.abs(dq).max(0), 1e-9))
    middle = (robot.upper + robot.lower) / 2
    return middle + scale * (q - (top + bottom) / 2), scale * dq, scale * ddq


def _payload_mask(simulation: Simulation, t: Array) -> Array | None:
    return None if simulation.payload is None else (t >= simulation.payload.at).astype(np.float64)


def _per_joint(name: str, value: float | Sequence[float], robot: Robot) -> Array:
    array = np.asarray(value, dtype=np.float64)
    if array.shape not in ((), (robot.n_joints,)):
        raise ValueError(
            f"{name} has shape {array.shape}, expected one number, or {robot.n_joints}, one for each joint"
        )
    if not np.isfinite(array).all() or (array < 0).any():
        raise ValueError(f"{name} is {value}, expected finite numbers of at least 0")
    return np.broadcast_to(array, (robot.n_joints,))


def _check(simulation: Simulation) -> None:
    for name, low in (("n_samples", 2), ("n_sinusoids", 1)):
        if getattr(simulation, name) < low:
            raise ValueError(f"{name} is {getattr(simulation, name)}, expected at least {low}")
    for name in ("rate", "speed"):
        if not 0 < getattr(simulation, name) < np.inf:
            raise ValueError(f"{name} is {getattr(simulation, name)}, expected a positive number")
    if not 0 <= simulation.noise < np.inf:
        raise ValueError(f"noise is {simulation.noise}, expected a number of at least 0")
    if simulation.course not in COURSES:
        raise ValueError(f"course is {simulation.course!r}, expected one of {', '.join(COURSES)}")
    if simulation.motion not in ("middle", "full"):
        raise ValueError(f"motion is {simulation.motion!r}, expected 'middle' or 'full'")
    if simulation.payload is not None:
        for name, amount in (("mass", simulation.payload.mass), ("at", simulation.payload.at)):
            if not 0 <= amount < np.inf:
                raise ValueError(f"payload {name} is {amount}, expected a number of at least 0")

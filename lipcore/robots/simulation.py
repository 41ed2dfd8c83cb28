"""Pinocchio-simulated robot streams: motion, noise, friction and a payload to choose, and the dirt of real arms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lipcore.data.samples import Array, Samples
from lipcore.robots.dirt import FINE_HZ, Dirt
from lipcore.robots.library import Robot, pinocchio

MotionRange = Literal["middle", "full"]
Course = Literal["sinusoids", "periodic", "rests"]

FUNDAMENTAL = 0.02
"""ω_f of eq. 16 of TR2023-063, rad/s."""
MIDDLE_AMPLITUDE = 0.5
"""Half range of a joint under `middle` motion, rad (m)."""
PERIOD = 10.0
"""Period of periodic motion at speed 1, s."""
FAST = 10.0
"""`speed` of the faster-moving variant: the same sums of sinusoids at ten times the frequency."""


@dataclass(frozen=True)
class Payload:
    """A point mass (kg) fixed to the last link from time `at` (s) on; offset (x, y, z) in m in the link's frame."""

    mass: float
    at: float = 0.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.1)


@dataclass(frozen=True)
class Stream:
    """What to simulate. Defaults are the paper's training set; its test sets have n_sinusoids = 100.

    rate in Hz; noise is the standard deviation of the measured torque in N·m; viscous (N·m·s/rad) and coulomb (N·m)
    friction are one number for all joints or one a joint; `speed` multiplies the fundamental frequency, or divides the
    period, or the time that moves take. course: the paper's `sinusoids`; `periodic`, few sinusoids again and again;
    `rests`, from point to point with rests between, all joints at once. dirt: of real arms, see `Dirt`, none where
    None: q, dq and ddq are then as measured, too.
    """

    n_samples: int = 500
    rate: float = 10.0
    n_sinusoids: int = 50
    motion: MotionRange = "middle"
    speed: float = 1.0
    noise: float = 0.01
    viscous: float | Sequence[float] = 0.0
    coulomb: float | Sequence[float] = 0.0
    payload: Payload | None = None
    course: Course = "sinusoids"
    dirt: Dirt | None = None


def simulate(robot: Robot, stream: Stream, seed: int) -> Samples:
    """Move the robot along its course and measure its torque.

    Equal arguments give equal samples. Raise ValueError for a stream that cannot be simulated.
    """
    _check(stream)
    rng = np.random.default_rng(seed)
    fine = 1 if stream.dirt is None else int(np.ceil(FINE_HZ / stream.rate))
    t = np.arange(stream.n_samples * fine) / (stream.rate * fine)
    q, dq, ddq = COURSES[stream.course](robot, stream, t, rng)
    tau = inverse_dynamics(robot, q, dq, ddq, _payload_mask(stream, t), stream.payload)
    tau += _per_joint("viscous", stream.viscous, robot) * dq + _per_joint("coulomb", stream.coulomb, robot) * np.sign(
        dq
    )
    if stream.dirt is not None:
        tau = stream.dirt.torque(t, q, dq, tau, usual_torque(robot), rng)
        q, dq, ddq = stream.dirt.motion(t, q)
    t, q, dq, ddq, tau = (np.ascontiguousarray(values[::fine]) for values in (t, q, dq, ddq, tau))
    tau = tau + stream.noise * rng.standard_normal(tau.shape)
    return Samples(robot.joint_names, t, np.zeros(len(t), dtype=np.int64), q, dq, ddq, tau)


def usual_torque(robot: Robot) -> Array:
    """How large each joint's torque usually is, (n,) N·m: its standard deviation over one fast stream.

    At least a tenth of the largest: a joint about a vertical axis has friction, too.
    """
    motion = sinusoids(robot, Stream(speed=FAST), np.arange(100) / 10.0, np.random.default_rng(0))
    spread = inverse_dynamics(robot, *motion).std(0)
    return np.asarray(np.maximum(spread, 0.1 * spread.max()))


def inverse_dynamics(
    robot: Robot, q: Array, dq: Array, ddq: Array, loaded: Array | None = None, payload: Payload | None = None
) -> Array:
    """Rigid-body torque (N, n) by Pinocchio's recursive Newton–Euler.

    q, dq, ddq: (N, n), SI; loaded: (N,), rows that are not zero carry the payload. Raise MissingExtraError.
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


def sinusoids(robot: Robot, stream: Stream, t: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Random sums of sinusoids within the joint's range and speed (eq. 16 of TR2023-063): q, dq, ddq, each (N, n).

    t: (N,) s; rng: where amplitudes are drawn from.
    """
    return _summed(robot, stream, t, rng, FUNDAMENTAL * stream.speed, stream.n_sinusoids)


def periodic(robot: Robot, stream: Stream, t: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Sums of five sinusoids that repeat every PERIOD / speed seconds: q, dq, ddq, each (N, n)."""
    return _summed(robot, stream, t, rng, 2 * np.pi * stream.speed / PERIOD, 5)


def _summed(
    robot: Robot, stream: Stream, t: Array, rng: np.random.Generator, fundamental: float, count: int
) -> tuple[Array, Array, Array]:
    """Random sums of sinusoids: `count` multiples of the fundamental, rad/s."""
    omega = fundamental * np.arange(1, count + 1)
    a, b = rng.uniform(-1, 1, (2, count, robot.n_joints))
    sin, cos = np.sin(np.outer(t, omega)), np.cos(np.outer(t, omega))
    q = sin @ (a / omega[:, None]) - cos @ (b / omega[:, None])
    dq = cos @ a + sin @ b
    ddq = -sin @ (a * omega[:, None]) + cos @ (b * omega[:, None])
    return _within(robot, stream, q, dq, ddq)


def rests(robot: Robot, stream: Stream, t: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Moves of least jerk between random points, with rests between them: q, dq, ddq, each (N, n).

    A move's share of its way after the share s of its time is 10 s³ − 15 s⁴ + 6 s⁵ (Flash & Hogan 1985).
    """
    q, dq, ddq = np.zeros((3, len(t), robot.n_joints))
    begin, here = 0.0, rng.uniform(-1, 1, robot.n_joints)
    while begin <= t[-1]:
        there = rng.uniform(-1, 1, robot.n_joints)
        move, rest = rng.uniform(1.0, 2.5) / stream.speed, rng.uniform(0.5, 2.0)
        rows = (t >= begin) & (t < begin + move + rest)
        s = np.minimum((t[rows] - begin) / move, 1.0)[:, None]
        way = there - here
        q[rows] = here + way * s**3 * (10 - 15 * s + 6 * s**2)
        dq[rows] = way * 30 * s**2 * (1 - s) ** 2 / move
        ddq[rows] = way * 60 * s * (1 - s) * (1 - 2 * s) / move**2
        begin, here = begin + move + rest, there
    return _within(robot, stream, q, dq, ddq)


COURSES = {"sinusoids": sinusoids, "periodic": periodic, "rests": rests}


def _within(robot: Robot, stream: Stream, q: Array, dq: Array, ddq: Array) -> tuple[Array, Array, Array]:
    """The same motion within the joints' range and speed."""
    half = (robot.upper - robot.lower) / 2
    reach = np.minimum(MIDDLE_AMPLITUDE, half) if stream.motion == "middle" else 0.95 * half
    top, bottom = q.max(0), q.min(0)
    scale = np.minimum(2 * reach / np.maximum(top - bottom, 1e-9), robot.speed / np.maximum(np.abs(dq).max(0), 1e-9))
    middle = (robot.upper + robot.lower) / 2
    return middle + scale * (q - (top + bottom) / 2), scale * dq, scale * ddq


def _payload_mask(stream: Stream, t: Array) -> Array | None:
    return None if stream.payload is None else (t >= stream.payload.at).astype(np.float64)


def _per_joint(name: str, value: float | Sequence[float], robot: Robot) -> Array:
    array = np.asarray(value, dtype=np.float64)
    if array.shape not in ((), (robot.n_joints,)):
        raise ValueError(f"{name} has shape {array.shape}, expected one number or {robot.n_joints}, one a joint")
    if not np.isfinite(array).all() or (array < 0).any():
        raise ValueError(f"{name} is {value}, expected finite numbers of at least 0")
    return np.broadcast_to(array, (robot.n_joints,))


def _check(stream: Stream) -> None:
    for name, low in (("n_samples", 2), ("n_sinusoids", 1)):
        if getattr(stream, name) < low:
            raise ValueError(f"{name} is {getattr(stream, name)}, expected at least {low}")
    for name in ("rate", "speed"):
        if not 0 < getattr(stream, name) < np.inf:
            raise ValueError(f"{name} is {getattr(stream, name)}, expected a positive number")
    if not 0 <= stream.noise < np.inf:
        raise ValueError(f"noise is {stream.noise}, expected a number of at least 0")
    if stream.course not in COURSES:
        raise ValueError(f"course is {stream.course!r}, expected one of {', '.join(COURSES)}")
    if stream.motion not in ("middle", "full"):
        raise ValueError(f"motion is {stream.motion!r}, expected 'middle' or 'full'")
    if stream.payload is not None:
        for name, amount in (("mass", stream.payload.mass), ("at", stream.payload.at)):
            if not 0 <= amount < np.inf:
                raise ValueError(f"payload {name} is {amount}, expected a number of at least 0")

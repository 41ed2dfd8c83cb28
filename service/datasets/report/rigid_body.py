"""How well a recording tells a robot's inertial parameters, and friction beside them: the regressor of its URDF at few
rows, against that of random motion over the robot's whole range.

In coordinates in which random motion excites every base parameter by 1, the recording excites some more and some less;
the least excited one limits what can be identified.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import arm_of_robot
from lipcore.kernels.friction import FRICTION_TERMS, SIGN_WIDTH
from lipcore.robots.library import SimulationUnavailableError
from lipcore.robots.urdf import PARAMETERS, RigidBody
from service.datasets.report.signals import Limits
from service.datasets.schema import WholeExcitation

MOST_EQUATIONS = 14_000
"""Rows times joints of the recording that are looked at: 2000 rows of 7 joints."""
CHUNK = 1000
"""Equations held at a time."""
REFERENCE_EQUATIONS = 3500
STRUCTURAL = 1e-8
"""Relative size below which a combination of parameters has no effect on torques."""
RESOLUTION = 1e-13
"""Smallest information about a weight, relative, that is told from none."""
EXCITED = 0.01
"""Share of random motion's excitation from which on a base parameter counts as excited."""
SPEED, TURN_S = 1.0, 0.5
"""Speed of random motion where no limit is known, rad/s or m/s, and the time in which it reverses, s."""
SEED = 7
TERMS = len(FRICTION_TERMS)


@dataclass(frozen=True)
class RigidExcitation:
    """What the URDF tells of a recording. friction: std of each joint's weights in the order FRICTION_TERMS, (n, 3)."""

    whole: WholeExcitation
    friction: Array


@dataclass(frozen=True)
class _Reference:
    """Random motion. regressor: (E, 10 n); base: columns that span it, (b,); back: (10 n, b) from coordinates in which
    it excites everything by 1.
    """

    regressor: Array
    base: NDArray[np.intp]
    back: Array


def judge_rigid_bodies(
    urdf: str,
    name: str,
    names: tuple[str, ...],
    limits: Limits,
    motion: tuple[Array, Array, Array],
    noise: Array,
    independent: float,
    gravity: bool,
) -> RigidExcitation | str:
    """Judge rows of motion q, dq, ddq, (R, n) each; a sentence says why where the URDF cannot be used for these joints.

    noise: std of what is left of each joint's torque, (n,) N·m; independent: samples that the rows stand for; gravity:
    whether torques contain it.
    """
    if limits.urdf_joints is None:
        return f"not all joints are those of robot {name}: its rigid bodies were not used"
    try:
        robot = RigidBody.from_urdf(urdf, names, limits.joint_types, limits.urdf_joints, name)
        kernel = ArmKernel(arm_of_robot(robot, gravity, "zero"))
    except (SimulationUnavailableError, ValueError) as error:
        return f"the rigid bodies of robot {name} were not used: {error}"
    n, size = len(names), len(names) * PARAMETERS
    reference = _reference(kernel, limits)
    rows = np.linspace(0, len(motion[0]) - 1, min(len(motion[0]), MOST_EQUATIONS // n)).astype(np.int64)
    q, dq, ddq = (each[rows] for each in motion)
    gram, information = np.zeros((size, size)), np.zeros((size + TERMS * n, size + TERMS * n))
    loudness = np.maximum(noise, 1e-9 * max(float(noise.max()), 1e-9))
    for first, block in _regressors(kernel, q, dq, ddq):
        gram += block.T @ block
        some = dq[first : first + len(block) // n]
        both = np.hstack([block, _friction(some)]) / np.tile(loudness, len(some))[:, None]
        information += both.T @ both
    excited, modes = np.linalg.eigh(reference.back.T @ gram @ reference.back / (n * len(q)))
    shares = np.sqrt(np.maximum(excited, 0.0))
    # whose parameters the least excited mode moves, weighed by the torque that random motion makes of them
    weakest = (reference.regressor * (reference.back @ modes[:, 0])).reshape(-1, n, PARAMETERS).sum(axis=2)
    whole = WholeExcitation(
        parameters=len(reference.base),
        rank=int(np.sum(shares > EXCITED)),
        condition=_condition(gram[np.ix_(reference.base, reference.base)]),
        weakest=float(shares[0]),
        weakest_body=names[int(np.square(weakest).sum(axis=0).argmax())],
    )
    return RigidExcitation(whole, _friction_stds(information * independent / len(q), reference.back))


def _reference(kernel: ArmKernel, limits: Limits) -> _Reference:
    motion = _random_motion(limits, max(1, REFERENCE_EQUATIONS // kernel.n_joints))
    regressor = np.concatenate([block for _, block in _regressors(kernel, *motion)])
    size = np.linalg.norm(regressor, axis=0)
    scale = np.where(size > 0, size, 1.0)
    _, values, directions = np.linalg.svd(regressor / scale, full_matrices=False)
    count = int(np.sum(values > STRUCTURAL * values[0]))
    back = directions[:count].T / values[:count] * np.sqrt(len(regressor)) / scale[:, None]
    base = np.sort(qr(regressor / scale, mode="r", pivoting=True)[1][:count])
    return _Reference(regressor, base, back)


def _friction(dq: Array) -> Array:
    """Friction's features as equations, row by row and joint by joint: (R n, 3 n)."""
    rows, n = dq.shape
    out = np.zeros((rows, n, n, TERMS))
    joints = np.arange(n)
    out[:, joints, joints] = np.stack([dq, np.tanh(dq / SIGN_WIDTH), np.ones_like(dq)], axis=2)
    return out.reshape(rows * n, TERMS * n)


def _friction_stds(information: Array, back: Array) -> Array:
    """Std of the friction's weights beside unknown inertial parameters, (n, 3); information: (13 n, 13 n)."""
    size, count = back.shape
    turn = np.zeros((len(information), count + len(information) - size))
    turn[:size, :count], turn[size:, count:] = back, np.eye(len(information) - size)
    base = turn.T @ information @ turn
    scale = np.sqrt(np.maximum(np.diag(base), 1e-300))
    values, vectors = np.linalg.eigh(base / np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, RESOLUTION)) @ vectors.T
    return np.asarray((np.sqrt(np.diag(inverse)) / scale)[count:].reshape(-1, TERMS))


def _condition(gram: Array) -> float | None:
    """Condition of a matrix with columns of equal norm, from its Gram matrix; None beyond what that can tell."""
    norm = np.sqrt(np.diag(gram))
    if (norm == 0).any():
        return None
    values = np.linalg.eigvalsh(gram / np.outer(norm, norm))
    return float(np.sqrt(values[-1] / values[0])) if values[0] > 1e-14 * values[-1] else None


def _regressors(kernel: ArmKernel, q: Array, dq: Array, ddq: Array) -> Iterator[tuple[int, Array]]:
    """The joint-torque regressor in blocks of equations, (CHUNK, 10 n) each, with the first row of motion of each."""
    rows = max(1, CHUNK // q.shape[1])
    for first in range(0, len(q), rows):
        part = slice(first, first + rows)
        features = kernel.features(Motion.from_arrays(q[part], dq[part], ddq[part])).numpy()
        masses = features[:, :, : PARAMETERS * q.shape[1]]
        yield first, masses.reshape(-1, masses.shape[2])


def _random_motion(limits: Limits, rows: int) -> tuple[Array, Array, Array]:
    """Positions over the whole range, speeds up to the limits and accelerations that reverse them soon, (rows, n)."""
    rng = np.random.default_rng(SEED)
    lower = np.where(np.isnan(limits.lower), -np.pi, limits.lower)
    upper = np.where(np.isnan(limits.upper), np.pi, limits.upper)
    speed = np.where(np.isnan(limits.speed), SPEED, limits.speed)
    shape = (rows, len(speed))
    return (
        rng.uniform(lower, upper, shape),
        rng.uniform(-speed, speed, shape),
        rng.uniform(-1, 1, shape) * speed / TURN_S,
    )

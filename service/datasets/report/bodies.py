"""Comparison of measured torque with the torque that a robot's rigid bodies need for the same motion.

Each joint is fitted by itself, with G the URDF's gravity torque and B its inertial and velocity torque:

    tau = g G + b B + v dq + c sign(dq) + o.

A recording of that robot in SI units has g = 1, and b = 1, or more if the URDF lacks rotors. Standard deviations and
errors come from fits that leave out one eighth of the recording at a time, because errors of neighbouring rows are
correlated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import spaced_rows
from lipcore.data.samples import Array
from lipcore.kernels.arm_prior import arm_of_robot
from lipcore.kernels.drive.terms import SIGN_WIDTH
from lipcore.kernels.fast.arm import arm_torques
from lipcore.robots.urdf import RigidBody
from service.datasets.report.fit import FIT
from service.datasets.report.signals import Limits


@dataclass(frozen=True)
class BodiesOptions:
    """Numbers of the comparison of torque with a robot's rigid bodies."""

    ridge: float = 1e-10
    """Penalty, as a share of a column's mean square: small, so that weights of collinear columns vary between fits."""
    floor: float = 1e-4
    """Error, as a share of a torque's variance, that units and clocks cause: a smaller error counts as this one."""
    min_moving: float = 0.2
    """Min share of moving rows for which a joint's rows at rest are ignored."""
    rows: int = 400
    """Max rows on which orders of joints are compared."""
    visible: float = 0.2
    """Share of a torque's standard deviation above which a part of it is visible."""
    min_gain: float = 3.0
    """Min ratio of errors for another order of joints, geometric mean over the joints that move."""
    explained: float = 0.5
    """Min explained share of each such joint's torque in the other order."""


BODIES = BodiesOptions()


@dataclass(frozen=True)
class BlockFit:
    """Least-squares fit of k columns y with p columns x, repeated without each of eight blocks of rows.

    weights: (p, k); std: (p, k), by jackknife over the blocks; errors: (8, k), mean squares on each held-out block.
    """

    weights: Array
    std: Array
    errors: Array

    @classmethod
    def of(cls, x: Array, y: Array) -> BlockFit:
        """Fit y (R, k) with x (R, p)."""
        scale = np.sqrt(np.mean(x**2, axis=0))
        x = x / np.where(scale > 0, scale, 1.0)
        edges = np.linspace(0, len(x), FIT.parts + 1).astype(np.int64)
        parts = [slice(*each) for each in pairwise(edges)]
        gram = np.array([x[part].T @ x[part] for part in parts])
        product = np.array([x[part].T @ y[part] for part in parts])
        ridge = BODIES.ridge * len(x) * np.eye(x.shape[1])
        weights = np.linalg.solve(gram.sum(0) + ridge, product.sum(0))
        without = np.linalg.solve(gram.sum(0) - gram + ridge, product.sum(0) - product)
        std = np.sqrt((FIT.parts - 1) / FIT.parts * np.sum((without - without.mean(0)) ** 2, axis=0))
        errors = np.array(
            [np.mean((y[part] - x[part] @ w) ** 2, axis=0) for part, w in zip(parts, without, strict=True)]
        )
        unit = np.where(scale > 0, scale, np.inf)[:, None]
        return cls(weights / unit, std / unit, errors)


class Signals(NamedTuple):
    """Motion and measured torque, (R, n) each, rows in order of time."""

    q: Array
    dq: Array
    ddq: Array
    tau: Array

    def take(self, columns: Sequence[int] | NDArray[np.int64]) -> Signals:
        """Return the same signals with joints in another order."""
        return Signals(*(each[:, columns] for each in self))


class Bodies:
    """Rigid-body torques of a robot, with joints in the order of the data."""

    def __init__(self, urdf: str, name: str, names: tuple[str, ...], limits: Limits) -> None:
        """Raise MissingExtraError, or ValueError if the URDF cannot be used for these joints."""
        robot = RigidBody.from_urdf(urdf, names, limits.joint_types, limits.urdf_joints, name)
        self.name, self.names, self.urdf_joints = name, names, robot.urdf_joints
        self._arm = arm_of_robot(robot)

    def torque(self, q: Array, dq: Array, ddq: Array, down: Sequence[float] | Array) -> Array:
        """Return torque (R, n), N·m, of motion (R, n) each, with gravity `down` (3,) m/s² in the base's frame."""
        arm, out = self._arm, np.zeros(q.shape)
        motions = np.stack([q, dq, ddq], axis=1)
        arm_torques(arm.geometry.constants, np.array(down, np.float64), arm.parameters, arm.order, motions, out)
        return out

    def parts(self, signals: Signals) -> tuple[Array, Array]:
        """Return the torque of gravity, and the torque of accelerations and velocities, (R, n) each."""
        rest = self.torque(*signals[:3], (0.0, 0.0, 0.0))
        return self.torque(*signals[:3], self._arm.geometry.gravity) - rest, rest

    def horizontal_gravity(self, q: Array) -> tuple[Array, Array]:
        """Return torques of gravity along two horizontal axes of the URDF's base, (R, n) each."""
        still = np.zeros_like(q)
        along = np.eye(3)[np.argsort(np.abs(self._arm.geometry.gravity))[:2]]
        first, second = (self.torque(q, still, still, 9.81 * axis) for axis in along)
        return first, second


def design_matrix(gravity: Array, rest: Array, dq: Array) -> Array:
    """Return columns (R, 5) of a joint's fit: gravity, inertia, velocity, its smoothed sign and a constant."""
    return np.column_stack([gravity, rest, dq, np.tanh(dq / SIGN_WIDTH), np.ones(len(dq))])


@dataclass(frozen=True)
class Comparison:
    """Torque compared with that of a robot: factors of gravity and inertia by joint, (n,) each."""

    gravity: Array
    gravity_std: Array
    inertia: Array
    inertia_std: Array
    visible: Array
    """Part of the gravity and inertia torque that other columns do not explain, as a share of tau's spread, (n, 2)."""
    errors: Array
    """Mean squares on each held-out eighth, as shares of the torque's variance, (8, n)."""

    @property
    def explained(self) -> Array:
        """Explained share of the variance on held-out eighths, (n,), at least 0."""
        return np.asarray(np.clip(1 - self.errors.mean(0), 0.0, 1.0))

    @property
    def visible_gravity(self) -> NDArray[np.bool_]:
        """Whether gravity is a visible part of each joint's torque, (n,)."""
        return np.asarray(self.visible[:, 0] > BODIES.visible)

    @property
    def error(self) -> float:
        """Mean logarithm of the errors."""
        return float(np.log(self.errors + BODIES.floor).mean())

    def is_significant(self, joint: int, part: int) -> bool:
        """Return whether a factor differs from 0 by three standard deviations and its torque is visible.

        part: 0 is gravity, 1 is inertia.
        """
        value, std = ((self.gravity, self.gravity_std), (self.inertia, self.inertia_std))[part]
        size = abs(value[joint])
        return bool(size > 3 * std[joint] and size * self.visible[joint, part] > BODIES.visible)


def moving_rows(dq: Array) -> NDArray[np.int64]:
    """Return the rows in which a joint moves, or all if it seldom does; at rest, friction may hold any torque."""
    rows = np.flatnonzero(np.abs(dq) > SIGN_WIDTH)
    return rows if len(rows) > BODIES.min_moving * len(dq) else np.arange(len(dq))


def _fits(bodies: Bodies, signals: Signals) -> Iterator[tuple[Array, float, BlockFit]]:
    """Yield for each joint the columns of its fit, the variance of its torque and the fit, on moving rows."""
    gravity, rest = bodies.parts(signals)
    for joint in range(signals.q.shape[1]):
        rows = moving_rows(signals.dq[:, joint])
        columns = design_matrix(gravity[rows, joint], rest[rows, joint], signals.dq[rows, joint])
        tau = signals.tau[rows, joint, None]
        yield columns, max(float(tau.var()), 1e-300), BlockFit.of(columns, tau)


def compare(bodies: Bodies, signals: Signals) -> Comparison:
    """Fit each joint's torque with gravity, inertia and friction."""
    factors, stds, visible, errors = [], [], [], []
    for columns, variance, fit in _fits(bodies, signals):
        factors.append(fit.weights[:2, 0])
        stds.append(fit.std[:2, 0])
        errors.append(fit.errors[:, 0] / variance)
        sizes = []
        for part in (0, 1):
            others = np.delete(columns, part, axis=1)
            left = columns[:, part] - others @ np.linalg.lstsq(others, columns[:, part], rcond=1e-9)[0]
            sizes.append(np.sqrt(np.mean(left**2) / variance))
        visible.append(sizes)
    (gravity, inertia), (gravity_std, inertia_std) = np.transpose(factors), np.transpose(stds)
    return Comparison(gravity, gravity_std, inertia, inertia_std, np.array(visible), np.transpose(errors))


@dataclass(frozen=True)
class Order:
    """Column of the data that belongs to each joint, (n,), and the mean logarithm of its errors."""

    column: tuple[int, ...]
    error: float


def find_torque_order(bodies: Bodies, signals: Signals) -> Order | None:
    """Return another order of the torque columns, if it is clearly better.

    Every column is fitted with the torque and friction of every joint. The assignment with the smallest errors wins.
    """
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415 - serving does without it

    gravity, rest = bodies.parts(signals)
    dq, tau, n = signals.dq, signals.tau, signals.q.shape[1]
    errors = np.empty((FIT.parts, n, n))
    for joint in range(n):
        rows = moving_rows(dq[:, joint])
        fit = BlockFit.of(design_matrix(gravity[rows, joint], rest[rows, joint], dq[rows, joint]), tau[rows])
        errors[:, joint] = fit.errors / np.maximum(tau[rows].var(axis=0), 1e-300)
    logs = np.log(errors + BODIES.floor)
    _, column = linear_sum_assignment(logs.mean(0))
    moved = np.flatnonzero(column != np.arange(n))
    if not len(moved):
        return None
    gain = logs[:, moved, moved] - logs[:, moved, column[moved]]
    # columns with little torque fit any joint: the explained share of each that moves counts
    explained = 1 - errors.mean(0)[moved, column[moved]]
    clear = (gain.mean(1) > 0).all() and gain.mean() > np.log(BODIES.min_gain) and (explained > BODIES.explained).all()
    return Order(tuple(column.tolist()), float(logs.mean(0)[np.arange(n), column].mean())) if clear else None


def find_joint_order(bodies: Bodies, signals: Signals, comparison: Comparison) -> Order | None:
    """Return another order of the joints in all columns, if it is clearly better.

    Candidates are the alphabetical order, the reverse and rotations. Exchanges of two joints improve the best one.
    """
    rows, n = signals.q.shape
    few = Signals(*(each[spaced_rows(rows, BODIES.rows)] for each in signals))
    scores: dict[tuple[int, ...], float] = {}

    def error(order: tuple[int, ...]) -> float:
        if order not in scores:
            fits = _fits(bodies, few.take(order))
            scores[order] = float(np.mean([np.log(fit.errors / variance + BODIES.floor) for _, variance, fit in fits]))
        return scores[order]

    here = tuple(range(n))
    by_name = np.argsort(np.argsort(bodies.urdf_joints))
    starts = {here, here[::-1], tuple(by_name.tolist()), tuple(np.argsort(by_name).tolist())}
    starts |= {here[k:] + here[:k] for k in range(1, n)}
    best = min(starts, key=error)
    while True:
        better = min((_exchanged(best, a, b) for a, b in combinations(range(n), 2)), key=error, default=best)
        if not error(better) < error(best):
            break
        best = better
    # joints with little torque keep their place, unless another one is clearly better
    for a, b in combinations(range(n), 2):
        back = _exchanged(best, a, b)
        if _moved(back) < _moved(best) and n * (error(back) - error(best)) < 2 * np.log(BODIES.min_gain):
            best = back
    moved = [joint for joint in range(n) if best[joint] != joint]
    if not moved:
        return None
    there = compare(bodies, signals.take(best))
    gain = (np.log(comparison.errors + BODIES.floor) - np.log(there.errors + BODIES.floor)).sum(1) / len(moved)
    significant = [joint for joint in range(n) if there.is_significant(joint, 0)]
    explained = np.median(there.explained[moved])
    clear = (gain > 0).all() and gain.mean() > np.log(BODIES.min_gain) and explained > BODIES.explained
    return Order(best, there.error) if clear and significant and (there.gravity[significant] > 0).all() else None


def _moved(order: tuple[int, ...]) -> int:
    return sum(column != joint for joint, column in enumerate(order))


def _exchanged(order: tuple[int, ...], a: int, b: int) -> tuple[int, ...]:
    out = list(order)
    out[a], out[b] = out[b], out[a]
    return tuple(out)

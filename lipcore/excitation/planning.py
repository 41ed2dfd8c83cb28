"""Plan the motion within limits that removes most of a model's variance."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.excitation.information import Belief, Information
from lipcore.excitation.limits import Limits
from lipcore.excitation.motions import Series, Shape, draw, harmonics
from lipcore.excitation.searching import MAX_INSTANTS, Goal, TorqueCheck, search
from lipcore.robots.library import Robot


@dataclass(frozen=True)
class PlanOptions:
    """Options of a plan. Raise ValueError if a value is impossible."""

    seconds: float = 50.0
    """Duration of the motion, s."""
    rate: float = 100.0
    """Sampling rate of the motion, Hz."""
    harmonics: int | None = None
    """Number of harmonics; None for as many as the limits allow."""
    iterations: int = 30
    """Iterations of the search."""
    starts: int = 8
    """Random starts of the search."""
    budget_s: float = 60.0
    """The search ends at the latest then, with the best motion so far."""
    references: int = 100
    """Motions, spread over the range, at which variance is computed."""
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("seconds", "rate", "budget_s"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} is {getattr(self, name)!r}, expected a positive number")
        if self.harmonics is not None and not 2 <= self.harmonics <= 1000:
            raise ValueError(f"harmonics is {self.harmonics!r}, expected a whole number from 2 to 1000")
        for name, low, high in (
            ("iterations", 0, 100_000),
            ("starts", 1, 1000),
            ("references", 2, 5000),
            ("seed", 0, 2**63),
        ):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} is {getattr(self, name)!r}, expected a whole number from {low} to {high}")
        if self.samples < 2:
            raise ValueError(f"{self.seconds} s at {self.rate} Hz are {self.samples} samples, expected at least 2")

    @property
    def samples(self) -> int:
        """Return the samples of the motion: it ends with its period, at rest."""
        return round(self.seconds * self.rate) + 1


@dataclass(frozen=True)
class Plan:
    """A planned motion."""

    series: Series
    limits: Limits
    options: PlanOptions
    information: Information
    left: Array
    """Share of the variance at the references that remains after measuring it, (n,): geometric mean over them."""
    used: Array
    """Max used share of the limits of position, speed, acceleration and torque, (4, n); NaN for a torque without a
    check."""
    iterations: int
    seconds: float
    out_of_time: bool
    """Whether the budget ended the search."""

    def table(self) -> tuple[Array, Array, Array, Array]:
        """Return times (N,), and positions, velocities and accelerations (N, n), at the planned rate."""
        t = np.arange(self.options.samples) / self.options.rate
        return t, *self.series.at(np.minimum(t, self.series.seconds))

    def left_by(self, q: Array, dq: Array, ddq: Array, repeats: float = 1.0) -> Array:
        """Return the share of variance that another motion of N samples leaves, each representing `repeats`: (n,)."""
        every = -(-len(q) // MAX_INSTANTS)
        motion = Motion.from_arrays(q[::every], dq[::every], ddq[::every])
        return np.asarray(self.information.left(motion, repeats * len(q) / len(motion)))


def plan(
    belief: Belief,
    limits: Limits,
    options: PlanOptions | None = None,
    robot: Robot | None = None,
    on_progress: Callable[[int, float], None] | None = None,
) -> Plan:
    """Search for the motion that leaves the least variance; equal arguments give equal motions.

    The objective is the mean logarithm of the remaining share of variance, over joints and over motions that
    are spread over the limits. robot: for torque limits. on_progress: receives iterations and that share (geometric
    mean). Raise ValueError if joints differ or no motion satisfies the limits.
    """
    options = options or PlanOptions()
    if belief.kernel.n_joints != limits.n_joints:
        raise ValueError(f"limits have {limits.n_joints} joints, the model has {belief.kernel.n_joints}")
    began = time.monotonic()
    reference = draw(limits, options.references, options.seed + 1)
    information = Information.about(belief, reference)
    shape = Shape.build(limits, options.seconds, options.harmonics or harmonics(limits, options.seconds))
    check = TorqueCheck(robot, limits) if robot is not None and np.isfinite(limits.torque).any() else None
    goal = Goal.build(shape, information, check, options.samples)
    until = began + options.budget_s
    result = search(goal, options.starts, options.iterations, options.seed, until, on_progress)
    series = shape.series(result.x)
    if check is not None:
        series = check.shrink(series)
    torque = np.full(limits.n_joints, np.nan) if check is None else check.used(series)
    used = np.vstack([series.used(limits), torque])
    took = time.monotonic() - began
    left = goal.left(series)
    return Plan(series, limits, options, information, left, used, result.iterations, took, result.out_of_time)

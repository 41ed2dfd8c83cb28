"""The search for a motion: random starts, the best of which is followed downhill, within limits of torque.

Torque is that of the URDF's rigid-body dynamics: friction is not in it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.excitation.information import Information
from lipcore.excitation.limits import Limits
from lipcore.excitation.motions import Series, Shape
from lipcore.robots.library import Robot, pinocchio
from lipcore.robots.simulation import inverse_dynamics

MARGIN = 0.99
"""Max share of a torque limit that is used at the instants that are checked."""
INSTANTS = 128
"""Instants that a motion is judged by: samples between them tell little more."""
OVER_WEIGHT = 100.0
"""Of the squared share by which a torque exceeds its limit, against nats of variance."""


@dataclass(frozen=True)
class TorqueCheck:
    """Compares a robot's torque with its limits. Build it where at least one limit is known."""

    robot: Robot
    limits: Limits

    def used(self, series: Series) -> Array:
        """Largest share of each joint's torque limit, (n,); 0 where there is none."""
        m = 16 * series.harmonics  # between these instants the torque may rise a little, hence the margin
        tau = inverse_dynamics(self.robot, *series.at(np.arange(m) / m * series.seconds))
        return np.asarray(np.abs(tau).max(0) / self.limits.torque)

    def excess(self, q: Array, dq: Array, ddq: Array) -> tuple[float, tuple[Array, Array, Array]]:
        """Mean over N instants of the squares by which shares exceed one, and its derivatives, each (N, n).

        q, dq, ddq: (N, n), SI.
        """
        pin, model = pinocchio(), self.robot.model
        data, out = model.createData(), tuple(np.zeros_like(q) for _ in range(3))
        total, limit = 0.0, self.limits.torque * MARGIN
        for k in range(len(q)):
            configuration = self.robot.configuration(q[k])
            over = np.maximum(np.abs(pin.rnea(model, data, configuration, dq[k], ddq[k])) / limit - 1, 0.0)
            if not over.any():
                continue
            total += float(over @ over) / len(q)
            weight = 2 * over * np.sign(data.tau) / limit / len(q)
            slopes = pin.computeRNEADerivatives(model, data, configuration, dq[k], ddq[k])
            inertia = np.triu(slopes[2]) + np.triu(slopes[2], 1).T  # only its upper half is filled in
            for part, slope in zip(out, (slopes[0], slopes[1], inertia), strict=True):
                part[k] = weight @ slope
        return total, (out[0], out[1], out[2])

    def hold(self, series: Series) -> Series:
        """The motion shrunk towards the middle of the range until the torque keeps its limits.

        Raise ValueError where not even standing still in the middle keeps them.
        """
        if (self.used(series) <= MARGIN).all():
            return series
        middle, low, high = self.limits.middle, 0.0, 1.0
        still = self.used(series.scaled(middle, 0.0))
        if (still > MARGIN).any():
            joint = int(still.argmax())
            raise ValueError(
                f"joint {self.limits.joint_names[joint]!r} needs {still[joint]:.0%} of its torque limit "
                f"{self.limits.torque[joint]:.3g} N·m to hold the robot still in the middle of its range, expected less"
            )
        for _ in range(30):
            factor = (low + high) / 2
            low, high = (factor, high) if (self.used(series.scaled(middle, factor)) <= MARGIN).all() else (low, factor)
        return series.scaled(middle, low)


@dataclass(frozen=True)
class Goal:
    """What is minimised over x (see Shape): mean log share of variance left, and a penalty on too large torques.

    t: instants judged; repeats: samples that each of them stands for.
    """

    shape: Shape
    information: Information
    check: TorqueCheck | None
    t: Array
    repeats: float

    @classmethod
    def build(cls, shape: Shape, information: Information, check: TorqueCheck | None, samples: int) -> Goal:
        """The goal for a motion that is sampled so often; check: of torque limits, None where none are known."""
        count = min(samples, INSTANTS)
        # in the middle of each interval: at the ends of the motion the robot rests
        t = (np.arange(count) + 0.5) / count * shape.seconds
        return cls(shape, information, check, t, samples / count)

    def left(self, series: Series) -> Array:
        """Share of each joint's variance that a series leaves, (n,)."""
        motion = Motion.from_arrays(*series.at(self.t))
        return np.asarray(self.information.left(motion, self.repeats))

    def value(self, x: Array) -> float:
        """What is to be small: the mean log share of variance left, nats, and the penalty. x: (2 K + 1, n)."""
        motion = Motion(*self.shape.motion(x, self.t))
        return float(np.log(self.information.left(motion, self.repeats)).mean()) + self._over(motion)[0]

    def slope(self, x: Array) -> tuple[float, Array]:
        """The value and its derivatives by x."""
        motion = Motion(*self.shape.motion(x, self.t))
        value, slope = self.information.slope(motion, self.repeats)
        over, more = self._over(motion)
        slopes = (one + OVER_WEIGHT * other for one, other in zip((slope.q, slope.dq, slope.ddq), more, strict=True))
        return value + over, self.shape.adjoint(x, self.t, *slopes)

    def _over(self, motion: Motion) -> tuple[float, tuple[Array, Array, Array]]:
        """The penalty, and its derivatives over its weight."""
        if self.check is None:
            none = np.zeros_like(motion.q)
            return 0.0, (none, none, none)
        value, slopes = self.check.excess(motion.q, motion.dq, motion.ddq)
        return OVER_WEIGHT * value, slopes


@dataclass(frozen=True)
class SearchResult:
    """Where a search ended. out_of_time: whether that was because of the time."""

    x: Array
    iterations: int
    out_of_time: bool


def search(
    goal: Goal,
    starts: int,
    iterations: int,
    seed: int,
    until: float,
    on_progress: Callable[[int, float], None] | None = None,
) -> SearchResult:
    """The best of random starts, followed by L-BFGS for so many iterations, or until that time of the monotonic clock.

    on_progress: called with iterations and the exponential of the lowest value so far.
    """
    rng = np.random.default_rng(seed)
    begun = [goal.shape.random(rng) for _ in range(starts)]
    best = min(begun, key=goal.value)
    return _Walk(goal, best, until, on_progress).run(iterations)


class _OutOfTimeError(Exception):
    pass


class _Walk:
    """One descent, which remembers the lowest point on its way."""

    def __init__(
        self, goal: Goal, begin: Array, until: float, on_progress: Callable[[int, float], None] | None
    ) -> None:
        self.goal, self.begin, self.until, self.on_progress = goal, begin, until, on_progress
        self.best, self.lowest, self.iterations = begin, np.inf, 0

    def run(self, iterations: int) -> SearchResult:
        from scipy.optimize import minimize  # noqa: PLC0415 - serving does without it

        if iterations == 0:
            return SearchResult(self.best, 0, False)
        options = {"maxiter": iterations, "maxcor": 20, "ftol": 0.0, "gtol": 0.0}
        try:
            minimize(self, self.begin.ravel(), jac=True, method="L-BFGS-B", callback=self._step, options=options)
        except _OutOfTimeError:
            return SearchResult(self.best, self.iterations, True)
        return SearchResult(self.best, self.iterations, False)

    def __call__(self, flat: Array) -> tuple[float, Array]:
        if time.monotonic() > self.until:
            raise _OutOfTimeError
        x = flat.reshape(self.begin.shape)
        value, slope = self.goal.slope(x)
        if value < self.lowest:
            self.lowest, self.best = value, x.copy()
        return value, slope.ravel()

    def _step(self, _: Array) -> None:
        self.iterations += 1
        if self.on_progress is not None:
            self.on_progress(self.iterations, float(np.exp(self.lowest)))

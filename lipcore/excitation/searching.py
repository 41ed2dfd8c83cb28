"""Search for a motion: random starts, the best of which is optimised, within torque limits.

Torque is that of the URDF's rigid-body dynamics, without friction.
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

MAX_TORQUE_SHARE = 0.99
"""Max used share of a torque limit at the instants that are checked."""
MAX_INSTANTS = 128
"""Max instants by which a motion is judged: samples between them add little."""
EXCESS_WEIGHT = 100.0
"""Weight of the squared share by which a torque exceeds its limit, against nats of variance."""


@dataclass(frozen=True)
class TorqueCheck:
    """Check of a robot's torque against its limits. At least one limit must be known."""

    robot: Robot
    limits: Limits

    def used(self, series: Series) -> Array:
        """Return the largest share of each joint's torque limit, (n,); 0 without a limit."""
        m = 16 * series.harmonics  # between these instants the torque may rise a little, hence the margin
        tau = inverse_dynamics(self.robot, *series.at(np.arange(m) / m * series.seconds))
        return np.asarray(np.abs(tau).max(0) / self.limits.torque)

    def excess(self, q: Array, dq: Array, ddq: Array) -> tuple[float, tuple[Array, Array, Array]]:
        """Return the mean over N instants of the squares by which shares exceed one, and its derivatives, each (N, n).

        q, dq, ddq: (N, n), SI.
        """
        pin, model = pinocchio(), self.robot.model
        data, out = model.createData(), tuple(np.zeros_like(q) for _ in range(3))
        total, limit = 0.0, self.limits.torque * MAX_TORQUE_SHARE
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

    def shrink(self, series: Series) -> Series:
        """Return the motion shrunk towards the middle of the range until the torque satisfies its limits.

        Raise ValueError if even standing still in the middle exceeds them.
        """
        if (self.used(series) <= MAX_TORQUE_SHARE).all():
            return series
        middle, low, high = self.limits.middle, 0.0, 1.0
        still = self.used(series.scaled(middle, 0.0))
        if (still > MAX_TORQUE_SHARE).any():
            joint = int(still.argmax())
            raise ValueError(
                f"joint {self.limits.joint_names[joint]!r} needs {still[joint]:.0%} of its torque limit "
                f"{self.limits.torque[joint]:.3g} N·m to hold the robot still in the middle of its range, expected less"
            )
        for _ in range(30):
            factor = (low + high) / 2
            low, high = (
                (factor, high)
                if (self.used(series.scaled(middle, factor)) <= MAX_TORQUE_SHARE).all()
                else (low, factor)
            )
        return series.scaled(middle, low)


@dataclass(frozen=True)
class Goal:
    """The objective over x (see Shape): mean log share of variance left, and a penalty on too large torques.

    t: instants judged; repeats: samples that each of them represents.
    """

    shape: Shape
    information: Information
    check: TorqueCheck | None
    t: Array
    repeats: float

    @classmethod
    def build(cls, shape: Shape, information: Information, check: TorqueCheck | None, samples: int) -> Goal:
        """Return the goal for a motion of `samples` samples; check: of torque limits, None if none are known."""
        count = min(samples, MAX_INSTANTS)
        # in the middle of each interval: at the ends of the motion the robot rests
        t = (np.arange(count) + 0.5) / count * shape.seconds
        return cls(shape, information, check, t, samples / count)

    def left(self, series: Series) -> Array:
        """Return the share of each joint's variance that a series leaves, (n,)."""
        motion = Motion.from_arrays(*series.at(self.t))
        return np.asarray(self.information.left(motion, self.repeats))

    def value(self, x: Array) -> float:
        """Return the objective: the mean log share of variance left, nats, plus the penalty. x: (2 K + 1, n)."""
        motion = Motion(*self.shape.motion(x, self.t))
        return float(np.log(self.information.left(motion, self.repeats)).mean()) + self._over(motion)[0]

    def slope(self, x: Array) -> tuple[float, Array]:
        """Return the objective and its derivatives by x."""
        motion = Motion(*self.shape.motion(x, self.t))
        value, slope = self.information.slope(motion, self.repeats)
        over, more = self._over(motion)
        slopes = (one + EXCESS_WEIGHT * other for one, other in zip((slope.q, slope.dq, slope.ddq), more, strict=True))
        return value + over, self.shape.adjoint(x, self.t, *slopes)

    def _over(self, motion: Motion) -> tuple[float, tuple[Array, Array, Array]]:
        """Return the penalty, and its derivatives divided by EXCESS_WEIGHT."""
        if self.check is None:
            none = np.zeros_like(motion.q)
            return 0.0, (none, none, none)
        value, slopes = self.check.excess(motion.q, motion.dq, motion.ddq)
        return EXCESS_WEIGHT * value, slopes


@dataclass(frozen=True)
class SearchResult:
    """The end of a search. out_of_time: whether the time limit ended it."""

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
    """Optimise the best of random starts by L-BFGS.

    It ends after `iterations`, or at a time of the monotonic clock.

    on_progress: receives iterations and the exponential of the lowest value so far.
    """
    rng = np.random.default_rng(seed)
    begun = [goal.shape.random(rng) for _ in range(starts)]
    best = min(begun, key=goal.value)
    return _Descent(goal, best, until, on_progress).run(iterations)


class _OutOfTimeError(Exception):
    pass


class _Descent:
    """One descent, which stores its lowest point."""

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

"""Torque limits of a motion, by the URDF's rigid-body dynamics: friction is not in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array
from lipcore.excitation.limits import Limits
from lipcore.excitation.motions import Series
from lipcore.robots.library import Robot, pinocchio
from lipcore.robots.simulation import inverse_dynamics

WATCHED = 16
"""Instants for each harmonic that the torque is looked at: between them it may rise a little, hence the margin."""
MARGIN = 0.99
"""Share of a torque limit that is used at most at those instants."""
HALVINGS = 30


@dataclass(frozen=True)
class TorqueCheck:
    """Compares a robot's torque with its limits. Build it where at least one limit is known."""

    robot: Robot
    limits: Limits

    def used(self, series: Series) -> Array:
        """Largest share of each joint's torque limit, (n,); 0 where there is none."""
        m = WATCHED * series.harmonics
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
        for _ in range(HALVINGS):
            factor = (low + high) / 2
            low, high = (factor, high) if (self.used(series.scaled(middle, factor)) <= MARGIN).all() else (low, factor)
        return series.scaled(middle, low)

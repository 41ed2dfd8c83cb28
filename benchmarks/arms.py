"""Random arms with any axes, any offsets and plausible masses, and other units of an arm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lipcore.robots.library import Robot, pinocchio
from lipcore.vocabulary import JointType


def another_unit(robot: Robot, share: float, seed: int) -> Robot:
    """Another unit of a robot: the same geometry, the mass of each body, and so its inertia, up to `share` off."""
    model, rng = robot.model.copy(), np.random.default_rng(seed)
    for joint in range(1, model.njoints):
        parameters = model.inertias[joint].toDynamicParameters()
        model.inertias[joint] = pinocchio().Inertia.FromDynamicParameters(
            parameters * rng.uniform(1 - share, 1 + share)
        )
    return replace(robot, model=model)


JOINTS = (3, 8)
"""Fewest and most joints."""
TILTED, TILT = 1 / 3, 0.5
"""Share of arms whose first axis is not upright, and how far it leans, rad."""
OFFSET, CENTRE = 0.2, 0.1
"""Spread of a joint's place in the frame before, and of a body's centre of mass, m."""
HEAVIEST, LIGHTER = 8.0, 0.7
"""Mass of the first body, kg, and of each next one as a share of that before."""
BULK = 0.06
"""Spread of a body's mass about its centre, m."""
REACH, SLIDE, SPEED = 2.5, 0.4, 2.5
"""Limits of position, rad and m, and of velocity, rad/s and m/s."""


def random_arm(seed: int, joints: int | None = None, prismatic: int | None = None) -> Robot:
    """A random arm; joints: n, 3 to 8 where None; prismatic: which joint slides, none where None.

    Equal arguments give equal arms.
    """
    pin, rng = pinocchio(), np.random.default_rng(seed)
    n = int(rng.integers(JOINTS[0], JOINTS[1] + 1)) if joints is None else joints
    types: list[JointType] = ["prismatic" if j == prismatic else "revolute" for j in range(n)]
    model, last = pin.Model(), 0
    for j, kind in enumerate(types):
        turn = pin.exp3(2 * rng.standard_normal(3))
        if j == 0:
            turn = pin.exp3(TILT * rng.standard_normal(3)) if rng.uniform() < TILTED else np.eye(3)
        place = OFFSET * rng.standard_normal(3) if j else np.zeros(3)
        joint = pin.JointModelPZ() if kind == "prismatic" else pin.JointModelRZ()
        last = model.addJoint(last, joint, pin.SE3(turn, place), f"joint{j + 1}")
        mass = HEAVIEST * LIGHTER**j * rng.uniform(0.5, 1.5)
        spread = BULK * rng.standard_normal((3, 3))
        moments = mass * (spread @ spread.T + 0.002 * np.eye(3))  # of a real body: ∫ r rᵀ dm is positive definite
        inertia = np.trace(moments) * np.eye(3) - moments
        body = pin.Inertia(mass, CENTRE * rng.standard_normal(3), inertia)
        model.appendBodyToJoint(last, body, pin.SE3.Identity())
    upper = np.where(np.array(types) == "prismatic", SLIDE, REACH)
    return Robot(f"random-{seed}", model, tuple(model.names)[1:], tuple(types), -upper, upper, np.full(n, SPEED))

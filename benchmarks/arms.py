"""Random arms with plausible masses, and further units of a given arm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lipcore.robots.library import Robot, pinocchio
from lipcore.vocabulary import JointType


def another_unit(robot: Robot, share: float, seed: int) -> Robot:
    """Return a robot of the same geometry; mass and inertia of each body differ by up to `share`."""
    model, rng = robot.model.copy(), np.random.default_rng(seed)
    for joint in range(1, model.njoints):
        parameters = model.inertias[joint].toDynamicParameters()
        model.inertias[joint] = pinocchio().Inertia.FromDynamicParameters(
            parameters * rng.uniform(1 - share, 1 + share)
        )
    return replace(robot, model=model)


JOINTS = (3, 8)
"""Min and max number of joints."""
TILTED_SHARE, TILT_RAD = 1 / 3, 0.5
"""Share of arms without an upright first axis, and the standard deviation of its tilt."""
JOINT_OFFSET_M, CENTRE_OFFSET_M = 0.2, 0.1
"""Standard deviation of a joint's position in its parent's frame, and of a body's centre of mass."""
FIRST_MASS_KG, MASS_RATIO = 8.0, 0.7
"""Mean mass of the first body, and the ratio of each further mean mass to the one before."""
BODY_SPREAD_M = 0.06
"""Spread of a body's mass about its centre."""
MAX_TURN_RAD, MAX_SLIDE_M, MAX_SPEED = 2.5, 0.4, 2.5
"""Limits of position, and of velocity in rad/s and m/s."""


def random_arm(seed: int, joints: int | None = None, prismatic: int | None = None) -> Robot:
    """Return a random arm, the same for equal arguments.

    Args:
        seed: seed of all random numbers.
        joints: number of joints; None: 3 to 8.
        prismatic: index of the prismatic joint; None: all joints are revolute.
    """
    pin, rng = pinocchio(), np.random.default_rng(seed)
    n = int(rng.integers(JOINTS[0], JOINTS[1] + 1)) if joints is None else joints
    types: list[JointType] = ["prismatic" if j == prismatic else "revolute" for j in range(n)]
    model, last = pin.Model(), 0
    for j, kind in enumerate(types):
        turn = pin.exp3(2 * rng.standard_normal(3))
        if j == 0:
            turn = pin.exp3(TILT_RAD * rng.standard_normal(3)) if rng.uniform() < TILTED_SHARE else np.eye(3)
        place = JOINT_OFFSET_M * rng.standard_normal(3) if j else np.zeros(3)
        joint = pin.JointModelPZ() if kind == "prismatic" else pin.JointModelRZ()
        last = model.addJoint(last, joint, pin.SE3(turn, place), f"joint{j + 1}")
        mass = FIRST_MASS_KG * MASS_RATIO**j * rng.uniform(0.5, 1.5)
        spread = BODY_SPREAD_M * rng.standard_normal((3, 3))
        moments = mass * (spread @ spread.T + 0.002 * np.eye(3))  # ∫ r rᵀ dm of a real body is positive definite
        inertia = np.trace(moments) * np.eye(3) - moments
        body = pin.Inertia(mass, CENTRE_OFFSET_M * rng.standard_normal(3), inertia)
        model.appendBodyToJoint(last, body, pin.SE3.Identity())
    upper = np.where(np.array(types) == "prismatic", MAX_SLIDE_M, MAX_TURN_RAD)
    return Robot(f"random-{seed}", model, tuple(model.names)[1:], tuple(types), -upper, upper, np.full(n, MAX_SPEED))

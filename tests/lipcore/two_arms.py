"""Two arms of two joints on one base, in a URDF, and their recordings with the joints of both in turn."""

import numpy as np

from lipcore import Samples
from lipcore.robots.library import Robot
from lipcore.robots.simulation import Simulation, simulate
from lipcore.robots.urdf import RigidBody
from tests.lipcore.robots.test_urdf import joint, link, robot

CHAIN = ("left 1", "left 2", "right 1", "right 2")
NAMES = ("left 1", "right 1", "left 2", "right 2")
"""Names of the joints in the order of the data."""
TYPES = ("revolute",) * 4
SIDES = np.array([0, 1, 0, 1])
"""Arm of each joint of the data."""
URDF = robot(
    *map(link, ("base", "upper", "lower", "other", "tool")),
    joint("left 1", "base", "upper"),
    joint("left 2", "upper", "lower"),
    joint("right 1", "base", "other").replace('xyz="0 0 0.3"', 'xyz="0.4 0 0.1" rpy="0.3 0 0.2"'),
    joint("right 2", "other", "tool"),
)


def two_arms() -> RigidBody:
    """Return the bodies for data in the order of NAMES."""
    return RigidBody.from_urdf(URDF, NAMES, TYPES)


def record_two_arms(seed: int, size: int = 200, noise: float = 0.01) -> Samples:
    """Simulate both arms with friction; joints in the order of NAMES."""
    model = RigidBody.from_urdf(URDF, CHAIN, TYPES).model
    limit = np.ones(4)
    simulated = Robot("arms", model, CHAIN, TYPES, -limit, limit, 4 * limit)
    samples = simulate(simulated, Simulation(size, speed=10, noise=noise, viscous=0.2, motion="full"), seed)
    return samples.joints(np.array([CHAIN.index(name) for name in NAMES]))

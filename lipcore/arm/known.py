"""Geometries of arms that are installed here: places to begin a search from, besides those drawn."""

from __future__ import annotations

from functools import lru_cache

from lipcore.kernels.geometry import Geometry
from lipcore.robots import ROBOTS, SimulationUnavailableError, UnknownRobotError, installed_profiles, load_robot
from lipcore.urdf import RigidBody
from lipcore.vocabulary import JointType


@lru_cache(maxsize=16)
def known_geometries(joint_types: tuple[JointType, ...], gravity: bool) -> tuple[Geometry, ...]:
    """Geometries of the robots of ROBOTS with these joints from base to tip; none where no URDFs are installed."""
    geometries = []
    for name in installed_profiles():
        if len(ROBOTS[name].free) != len(joint_types):
            continue
        try:
            robot = load_robot(name)
        except (UnknownRobotError, SimulationUnavailableError, ValueError):
            continue
        if robot.joint_types == joint_types:
            body = RigidBody.from_profile(name, robot.joint_names, robot.joint_types)
            geometries.append(Geometry.from_robot(body, gravity))
    return tuple(geometries)

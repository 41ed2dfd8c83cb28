"""Arms to begin a search from: drawn, near another one, or installed here."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import lru_cache

import numpy as np

from lipcore.data.samples import Array
from lipcore.kernels.geometry import STANDARD_GRAVITY, Geometry, aligned, rotation_of
from lipcore.robots.library import ROBOTS, SimulationUnavailableError, installed_profiles
from lipcore.robots.urdf import JointMismatchError, RigidBody, UrdfError
from lipcore.vocabulary import JointType

RIGHT_ANGLED = np.array([[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], np.float64)
DIRECTION_SHARES = (0.25, 0.05, 0.175, 0.175, 0.175, 0.175)
"""How often an axis goes on as the one before, turns back, or lies across it: as arms are built."""
UPRIGHT_SHARE, RIGHT_BASE_SHARE = 0.5, 0.7
"""How often the first axis is upright, and, up to here, how often it is upright, upside down or level."""
SIDE, LONG = 0.2, 0.3
"""Widths of where the next axis lies, m: across and along the one before."""
HOPS = 7


def draw(rng: np.random.Generator, joint_types: tuple[JointType, ...], gravity: bool) -> Geometry:
    """A random arm with right angles, its first axis mostly upright, sometimes any way.

    joint_types: (n,), base to tip; gravity: whether torques contain it.
    """
    n = len(joint_types)
    rotation, translation = np.empty((n, 3, 3)), np.zeros((n, 3))
    for j in range(n):
        kind = rng.uniform()
        if j or kind >= UPRIGHT_SHARE:
            direction = RIGHT_ANGLED[rng.choice(6, p=DIRECTION_SHARES)]
            if not j:
                direction = RIGHT_ANGLED[rng.integers(6)] if kind < RIGHT_BASE_SHARE else _unit(rng)
        else:
            direction = RIGHT_ANGLED[0]
        rotation[j] = aligned(direction) @ rotation_of(np.array([0.0, 0.0, rng.integers(4) * np.pi / 2]))
        if not j:  # where the first joint's zero lies relative to a tilt, nobody knows
            rotation[j] = rotation[j] @ rotation_of(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
        elif joint_types[j] == "revolute":
            translation[j] = rng.normal(0, [SIDE, SIDE, LONG])
    axis = np.tile([0.0, 0.0, 1.0], (n, 1))
    return Geometry(joint_types, rotation, translation, axis, weight(gravity)).canonical()


def hop(rng: np.random.Generator, geometry: Geometry) -> Geometry:
    """Another arm near an optimum: one or two joints turned, mirrored, reversed, moved, shaken or drawn anew."""
    rotation, translation, n = geometry.rotation.copy(), geometry.translation.copy(), geometry.n_joints
    for j in rng.choice(n, min(int(rng.integers(1, 3)), n), replace=False):
        axis, kind = geometry.axis[j], rng.integers(HOPS)
        if kind == 0:  # all that follows, by a quarter or half about this axis
            rotation[j] = rotation[j] @ rotation_of(axis * rng.choice([0.5, 1.0, -0.5]) * np.pi)
        elif kind == 1:  # a right angle
            rotation[j] = aligned(RIGHT_ANGLED[rng.integers(6)]) @ aligned(axis).T
        elif kind == 2:  # mirrored about the axis before
            half = rotation_of(np.pi * (geometry.axis[j - 1] if j else np.array([0.0, 0.0, 1.0])))
            rotation[j] = half @ rotation[j] @ half
        elif kind == 3:  # anew
            rotation[j] = aligned(_unit(rng)) @ rotation_of(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
            translation[j] = rng.normal(0, LONG, 3)
        elif kind == 4:  # to the other side
            translation[j] = -translation[j]
        elif kind == 5:  # the other sense of turning
            rotation[j] = rotation[j] @ rotation_of(np.pi * geometry.across[j, rng.integers(2)])
        else:  # a little
            rotation[j] = rotation[j] @ rotation_of(rng.normal(0, 0.5, 3))
            translation[j] = translation[j] + rng.normal(0, SIDE, 3)
    return replace(geometry, rotation=rotation, translation=translation).canonical()


def weight(gravity: bool) -> Array:
    """Gravity in the base's frame, or none."""
    return np.array([0.0, 0.0, -STANDARD_GRAVITY if gravity else 0.0])


def _unit(rng: np.random.Generator) -> Array:
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


@lru_cache(maxsize=16)
def known_geometries(joint_types: tuple[JointType, ...], gravity: bool) -> tuple[Geometry, ...]:
    """Geometries of the robots of ROBOTS with these joints from base to tip; none where no URDFs are installed.

    joint_types: (n,), from base to tip; gravity: whether torques contain it. A robot that is no serial arm of such
    joints is left out.
    """
    geometries = []
    for name in installed_profiles():
        joints = ROBOTS[name].free
        if len(joints) == len(joint_types):
            with suppress(JointMismatchError, UrdfError, SimulationUnavailableError):
                geometries.append(Geometry.from_robot(RigidBody.from_profile(name, joints, joint_types), gravity))
    return tuple(geometries)

"""The names that things go by in models, data and answers. It loads no numerics: clients name things too."""

from __future__ import annotations

from enum import IntEnum
from typing import Literal, get_args

JointType = Literal["revolute", "prismatic"]
JOINT_TYPES: tuple[JointType, ...] = get_args(JointType)

TorqueConvention = Literal["gravity_included", "gravity_compensated"]
"""What a torque means: all of it (Franka's `tau_J`), or what is added to gravity compensation (its commands)."""
TORQUE_CONVENTIONS: tuple[TorqueConvention, ...] = get_args(TorqueConvention)

EffortMeaning = Literal["measured", "commanded", "current", "unknown"]
"""Measured torque, gravity included; commanded torque, what is added to gravity compensation; motor current, A."""

Place = Literal["cpu", "cuda"]
"""What computes."""

ComponentName = Literal[
    "inertia_matrix",
    "coriolis",
    "gravity",
    "inertial",
    "friction",
    "kinetic_energy",
    "potential_energy",
    "forward_dynamics",
]
COMPONENTS: tuple[ComponentName, ...] = get_args(ComponentName)

AUTO = "auto"
"""Of several estimators, the simplest unless another one is surely better (`lipcore.training.auto`)."""
RIGID, LOCAL, CHAINED_ARM = "rigid-body", "rigid-body+local", "rigid-body+lip-chain"
ROBOT_ESTIMATORS = (RIGID, LOCAL, CHAINED_ARM)
"""Estimators with the term `rigid_body`, which take a robot."""
CHOICES = (AUTO, "lip", "lip-chain", "se", "gip", "lse", *ROBOT_ESTIMATORS)
"""What may be asked for: `auto`, and the estimators of `lipcore.estimators.catalogue`."""

DIFFERENTIATED = ("se", "gip", "lse")
"""Estimators that torch differentiates as they are trained, on a GPU if there is one: the extra `train`. What they
answer needs none."""

GeometryMode = Literal["learn", "calibrate", "fixed"]
GEOMETRY_MODES: tuple[GeometryMode, ...] = get_args(GeometryMode)
"""Where the joint axes of rigid bodies lie: learnt from torque alone, learnt around a URDF or another unit's arm, or as
that has them."""

Prior = Literal["urdf", "zero"]
PRIORS: tuple[Prior, ...] = get_args(Prior)
"""What inertial parameters are expected to be before the data speak: those of the URDF, or none."""

PayloadState = Literal["none", "payload", "contact", "friction"]
"""What the last rows of a stream show: something carried, a contact, other friction, or none of these."""


class Code(IntEnum):
    """What becomes of a row. All but `LEARNT` keep it out of learning; the log stores the numbers."""

    LEARNT = 0
    NON_FINITE = 1
    """A number is not finite."""
    LIMIT = 2
    """A position, velocity, acceleration or torque is beyond its limit."""
    TIME_JUMP = 3
    """Time goes backwards or leaps."""
    SATURATION = 4
    """Torque is at its actuator's limit."""
    STATIONARY = 5
    """The robot is at rest: stiction hides its torque."""
    CONTACT = 6
    CHANGE = 7
    """The robot has changed, and its owner has not decided yet."""
    EDGE = 8
    """The acceleration cannot be derived, at the edge of what has come."""
    PAYLOAD = 9
    """The arm carries something, of which the row teaches instead."""
    LATE = 10
    """The row came so late that by forgetting it no longer counts."""
    PAUSED = 11
    """Learning was paused."""
    IMPLAUSIBLE = 12
    """Nobody has measured this torque."""


CODES = tuple(code.name.lower() for code in Code)
"""The names of codes, in the order of their numbers."""

"""The names that things go by in models, data and answers. It loads no numerics: clients name things too."""

from __future__ import annotations

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

CODES = (
    *("learnt", "non_finite", "limit", "time_jump", "saturation", "stationary"),
    *("contact", "change", "edge", "payload", "late", "paused", "implausible"),
)
"""What may become of a row. All but the first keep it out of learning: a number that is not finite; a position,
velocity, acceleration or torque beyond its limit; time that goes backwards or leaps; torque at its actuator's limit; a
robot at rest, whose stiction hides its torque; a contact; a changed robot whose owner has not decided yet; the edge of
a recording, where an acceleration cannot be derived; an arm that carries something, of which it teaches instead; a row
that came so late that by forgetting it no longer counts; one that came while learning was paused; a torque that nobody
has measured."""
LEARNT = 0

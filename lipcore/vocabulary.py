"""Define the names that models, data and responses share. This module loads no numerics: clients import it, too."""

from __future__ import annotations

from enum import IntEnum
from typing import Literal, get_args

JointType = Literal["revolute", "prismatic"]
JOINT_TYPES: tuple[JointType, ...] = get_args(JointType)

TorqueConvention = Literal["gravity_included", "gravity_compensated"]
"""What a torque contains: all torque (Franka's `tau_J`), or only what is added to gravity compensation (its
commands)."""
TORQUE_CONVENTIONS: tuple[TorqueConvention, ...] = get_args(TorqueConvention)

EffortMeaning = Literal["measured", "commanded", "current", "unknown"]
"""Measured torque with gravity; commanded torque, which is added to gravity compensation; motor current, A."""

Device = Literal["cpu", "cuda"]
"""The device that computes."""

ComponentName = Literal[
    "inertia_matrix",
    "coriolis",
    "gravity",
    "inertial",
    "friction",
    "without_gravity",
    "kinetic_energy",
    "potential_energy",
    "forward_dynamics",
]
COMPONENTS: tuple[ComponentName, ...] = get_args(ComponentName)

AUTO = "auto"
"""The simplest estimator, unless another one is significantly better (`lipcore.training.auto`)."""
RIGID, LOCAL, CHAINED_ARM = "rigid-body", "rigid-body+local", "rigid-body+lip-chain"
ROBOT_ESTIMATORS = (RIGID, LOCAL, CHAINED_ARM)
"""Estimators with the term `rigid_body`, which need a robot."""
ESTIMATOR_CHOICES = (AUTO, "lip", "lip-chain", "se", "gip", "lse", *ROBOT_ESTIMATORS)
"""Values of `estimator` in a request: `auto`, and the estimators of `lipcore.estimators.catalogue`."""

ENERGY_ESTIMATORS = ("lip", "lip-chain", *ROBOT_ESTIMATORS)
"""Estimators whose torque follows from energies."""

TORCH_ESTIMATORS = ("se", "gip", "lse")
"""Estimators that torch differentiates in training, on a GPU if there is one. They need the extra `train`; their
predictions do not."""

DriveKind = Literal["stribeck", "speed", "sides", "position", "load", "gain", "play"]
DRIVE_KINDS: tuple[DriveKind, ...] = get_args(DriveKind)
"""Kinds of friction beyond viscous, Coulomb and offset (`lipcore.kernels.drive.terms`)."""

GeometryMode = Literal["learn", "calibrate", "fixed"]
GEOMETRY_MODES: tuple[GeometryMode, ...] = get_args(GeometryMode)
"""How the joint axes of rigid bodies are found: learnt from torque alone, learnt around a URDF or the arm of another
unit, or fixed as given there."""

ExportFormat = Literal["archive", "urdf", "mjcf", "c", "onnx", "torch", "jax"]
EXPORT_FORMATS: tuple[ExportFormat, ...] = get_args(ExportFormat)
"""What a version is exported as: an archive for another service, or a format of `lipcore.export.formats`."""

Prior = Literal["urdf", "zero"]
PRIORS: tuple[Prior, ...] = get_args(Prior)
"""Prior mean of the inertial parameters: those of the URDF, or zero."""

PayloadState = Literal["none", "payload", "contact", "friction"]
"""What the last rows of a stream show: a payload, a contact, changed friction, or none of these."""


class Code(IntEnum):
    """Why a row was learnt or rejected. Only `LEARNT` rows are learnt; the log stores the numbers."""

    LEARNT = 0
    NON_FINITE = 1
    """A number is not finite."""
    LIMIT = 2
    """A position, velocity, acceleration or torque is beyond its limit."""
    TIME_JUMP = 3
    """Time goes backwards or jumps ahead."""
    SATURATION = 4
    """The torque is at its actuator's limit."""
    STATIONARY = 5
    """The robot is at rest: stiction hides its torque."""
    CONTACT = 6
    CHANGE = 7
    """The robot has changed, and learning is paused until its owner decides."""
    EDGE = 8
    """The acceleration cannot be derived yet, because neighbouring rows are missing."""
    PAYLOAD = 9
    """The arm carries a payload. The row is used to estimate the payload instead."""
    LATE = 10
    """The row arrived so late that forgetting leaves it no weight."""
    PAUSED = 11
    """Learning was paused."""
    IMPLAUSIBLE = 12
    """The torque cannot be a measurement."""


CODES = tuple(code.name.lower() for code in Code)
"""Names of the codes, in the order of their numbers."""


def offered_components(estimator: str) -> tuple[ComponentName, ...]:
    """Return the components of an estimator: all if its torque follows from energies, else friction only."""
    return COMPONENTS if estimator in ENERGY_ESTIMATORS else ("friction",)

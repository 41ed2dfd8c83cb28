"""The prior of an arm: its geometry, its masses, and the uncertainty of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.kernels.drive.kernel import Bodies, Drive, Elements
from lipcore.kernels.drive.play import element_widths
from lipcore.kernels.fast.arm_recursion import PARAMETERS
from lipcore.kernels.geometry import Geometry
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import DriveKind, GeometryMode, JointType, Prior

KINDS = (0, 1, 1, 1, 2, 2, 2, 2, 2, 2)
"""Index of the scale of each of a body's ten parameters: mass, first moment or inertia."""


@dataclass(frozen=True)
class Alternative:
    """Another arm that explains the recording nearly as well, at its most likely parameters."""

    geometry: Geometry
    """Geometry, base to tip."""
    parameters: Array
    """Inertial parameters of the bodies, (n, 10), base to tip."""
    rotor: Array
    """Rotor inertias, (n,) kg·m², in the order of the data's joints."""
    friction: Array
    """Coefficients of the drive's terms, (n, f), in the order of the data's joints."""
    probability: float
    """Probability of this arm, from the evidence."""


@dataclass(frozen=True)
class Arm:
    """Rigid bodies of one arm, or of several on one base, with torque linearised around geometry and parameters."""

    geometry: Geometry
    """Geometry, base to tip."""
    order: NDArray[np.int64]
    """The data's joint at each place of the chain, (n,)."""
    mode: GeometryMode
    """Source of the geometry."""
    parameters: Array
    """Inertial parameters at which ∂(Y π)/∂θ is computed, (n, 10), base to tip."""
    centre: Array
    """Prior mean of π, (n, 10), base to tip."""
    unit: Array
    """Prior standard deviations of π and of the rotor inertias, (11 n,), in the order of the data's joints."""
    rotor: Array
    """Prior mean of the rotor inertias, (n,) kg·m², in the order of the data's joints."""
    expected: Array
    """Step from the geometry to its prior mean, (g,) rad and m."""
    widths: Array
    """Prior standard deviations of the geometry, (g,) rad and m."""
    drive: tuple[DriveKind, ...] = ()
    """Kinds of friction beyond viscous, Coulomb and offset (`lipcore.kernels.drive.terms`)."""
    acceleration: Array | None = None
    """Usual acceleration of the joints, (n,) rad/s² (m/s²), in the order of the data, for the kind `play`."""
    alternatives: tuple[Alternative, ...] = field(default=())
    """The arm itself, then the other arms; empty if there is no other."""

    def __post_init__(self) -> None:
        n, steps = self.geometry.n_joints, 0 if self.mode == "fixed" else self.geometry.size
        for name, shape in (
            ("parameters", (n, PARAMETERS)),
            ("centre", (n, PARAMETERS)),
            ("unit", ((PARAMETERS + 1) * n,)),
            ("rotor", (n,)),
            ("expected", (steps,)),
            ("widths", (steps,)),
        ):
            value = getattr(self, name)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"{name} has shape {value.shape}, expected finite numbers of shape {shape}")
        if sorted(self.order.tolist()) != list(range(n)):
            raise ValueError(f"order is {self.order.tolist()}, expected each joint from 0 to {n - 1} once")
        if not ((self.unit > 0).all() and (self.widths > 0).all()):
            raise ValueError("unit and widths are standard deviations, expected only positive numbers")

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return self.geometry.n_joints

    @property
    def arm_of_joints(self) -> NDArray[np.int64]:
        """Index of the arm of each joint, (n,), in the order of the data's joints."""
        out = np.empty_like(self.order)
        out[self.order] = self.geometry.arm_of
        return out

    @property
    def geometries(self) -> tuple[Geometry, ...]:
        """The arm's geometry, then those of the alternatives."""
        return (self.geometry, *(each.geometry for each in self.alternatives[1:]))

    @property
    def steps(self) -> int:
        """Number of learnt numbers of the geometry; zero if it is fixed."""
        return len(self.widths)

    @property
    def place(self) -> NDArray[np.int64]:
        """Place in the chain of each joint of the data, (n,)."""
        return np.argsort(self.order)

    @property
    def arm_of(self) -> NDArray[np.int64]:
        """Index of the arm of each joint of the data, (n,)."""
        return self.geometry.arm_of[self.place]

    @property
    def joint_types(self) -> tuple[JointType, ...]:
        """Types of the joints, (n,), in the order of the data."""
        return tuple(self.geometry.joint_types[place] for place in self.place)

    def part(self, number: int) -> Arm:
        """Return one of several arms by itself, for data with its joints from base to tip, without its friction."""
        joints, numbers, geometry = self.geometry.arms[number]
        data, bodies = self.order[joints], PARAMETERS * self.n_joints
        units = self.unit[:bodies].reshape(-1, PARAMETERS)[data], self.unit[bodies:][data]
        return Arm(
            geometry,
            np.arange(len(data)),
            self.mode,
            self.parameters[joints],
            self.centre[joints],
            np.concatenate([each.reshape(-1) for each in units]),
            self.rotor[data],
            self.expected[numbers] if self.steps else self.expected,
            self.widths[numbers] if self.steps else self.widths,
        )

    @cached_property
    def friction(self) -> Drive:
        """The drive, in the order of the data's joints."""
        elements = None
        if self.acceleration is not None:
            elements = Elements(element_widths(self.joint_types), self.acceleration)
        return Drive(self.n_joints, self.drive, Bodies(self.geometry, self.parameters, self.order), elements)


def arm_of_robot(robot: RigidBody, gravity: bool = True, prior: Prior = "urdf", mode: GeometryMode = "fixed") -> Arm:
    """Return the arm of a URDF before any samples. `mode` decides whether its geometry is learnt.

    The prior standard deviation of the masses is a tenth of the URDF's masses, or all of them if the prior is "zero".
    Raise ValueError if the prior is "urdf" and the URDF has no masses.
    """
    mass = robot.parameters()[:, 0]
    if mass.sum() <= 0 and prior == "urdf":
        raise ValueError(f"robot {robot.name!r} has no mass in its URDF, expected inertial parameters or prior 'zero'")
    geometry, order = Geometry.from_robot(robot, gravity), chain(robot, robot.n_joints)
    unit = unit_of(robot, ROTOR_SHARE * max(float(mass.max()), 1e-3))
    unit[: PARAMETERS * robot.n_joints] *= 0.1 if prior == "urdf" else 1.0
    steps = 0 if mode == "fixed" else geometry.size
    bodies = robot.parameters()[order]
    return Arm(
        geometry,
        order,
        mode,
        bodies,
        bodies if prior == "urdf" else np.zeros_like(bodies),
        unit,
        robot.rotors() if prior == "urdf" else np.zeros(robot.n_joints),
        np.zeros(steps),
        widths_of(geometry)[:steps],
    )


def widths_of(geometry: Geometry) -> Array:
    """Return the standard deviations of a unit's geometry around that of its type, (g,) rad and m.

    Axes of two units, or of a unit and its URDF, differ by 0.005 rad and 0.003 m; their bases differ by 0.02 rad.
    Machining is more accurate. But an earlier posterior, reduced to single numbers, loses the correlations between
    them. These values and `WIDTHS.unit` of `lipcore.arm.problem` were tuned on simulated arms (50 and 51 of
    `benchmarks/studies/learnt_arm.py transfer`). A fifth of them sometimes ended in a poor optimum that counts part of
    the torque as noise.
    """
    widths = np.where(geometry.turns, 0.005, 0.003)
    for _, numbers, arm in geometry.arms:
        widths[numbers][: arm.screws[0]] = 0.02
    return widths


def unit_of(robot: RigidBody, rotor: float) -> Array:
    """Return the usual size of a URDF's parameters, (11 n,), in the order of the data's joints.

    The sizes are m_i, m_i ℓ and m_i ℓ² for mass, first moment and inertia of a body. rotor: kg·m². A link without mass
    in the URDF may still have 2 % of the arm's mass.
    """
    mass = robot.parameters()[:, 0]
    total = float(mass.sum())
    scale = np.maximum(mass, 0.02 * total) if total > 0 else np.ones(robot.n_joints)
    powers = robot.length() ** np.array(KINDS)
    return np.concatenate([(scale[:, None] * powers).reshape(-1), np.full(robot.n_joints, rotor)])


def unit_from_torque(torque: float, joints: int) -> Array:
    """Return the usual size of the parameters of an arm, (11 n,), given only its largest torque, N·m.

    They are those of a mass that causes this torque at a lever of 0.3 m.
    """
    lever = 0.3
    mass = max(torque, 1e-3) / (9.81 * lever)
    body = mass * np.array([1.0, lever, 2 * lever**2])[list(KINDS)]
    return np.concatenate([np.tile(body, joints), np.full(joints, ROTOR_SHARE * mass)])


ROTOR_SHARE = 0.03
"""Expected rotor inertia, m² times the mass of an arm's heaviest body."""


def chain(robot: RigidBody | None, joints: int) -> NDArray[np.int64]:
    """Return the data's joint at each place of the chain, (n,). Without a URDF it is the order of the data."""
    return np.arange(joints) if robot is None else np.argsort(robot.order)


def in_chain(values: Array, order: Sequence[int] | NDArray[np.int64]) -> Array:
    """Return columns in the order of the data, (N, n), reordered from base to tip."""
    return np.ascontiguousarray(values[:, order])

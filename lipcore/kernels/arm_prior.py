"""An arm as a model stands on it: its geometry, the masses there, and how sure both were beforehand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.kernels.fast.arm_recursion import PARAMETERS
from lipcore.kernels.geometry import Geometry
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import GeometryMode, Prior

KINDS = (0, 1, 1, 1, 2, 2, 2, 2, 2, 2)
"""Which scale each of a body's ten parameters has: mass, first moment or inertia."""


@dataclass(frozen=True)
class Alternative:
    """Another arm that explains the recording nearly as well, as the most likely parameters make it.

    geometry: base to tip; parameters: (n, 10), base to tip; rotor: (n,) kg·m²; friction: (n, f), coefficients of the
    friction kernel's features; both in the order of the data's joints. probability: of it, from the evidence.
    """

    geometry: Geometry
    parameters: Array
    rotor: Array
    friction: Array
    probability: float


@dataclass(frozen=True)
class Arm:
    """Rigid bodies whose torque is taken as linear around this geometry and these parameters.

    geometry: base to tip; order: (n,), the data's joint at each place of the chain; mode: where the geometry is from;
    parameters: (n, 10), base to tip, at which ∂(Y π)/∂θ is taken; centre: (n, 10), prior mean of π, base to tip; unit:
    (11 n,), prior standard deviations of π and of the rotor inertias, in the order of the data's joints; rotor: (n,),
    prior mean of the latter, likewise; expected: (g,), the step from the geometry to its prior mean; widths: (g,), its
    prior standard deviations, rad and m.
    stribeck: whether friction has its fourth term; alternatives: the arm itself first, then the others; empty where
    there is no other.
    """

    geometry: Geometry
    order: NDArray[np.int64]
    mode: GeometryMode
    parameters: Array
    centre: Array
    unit: Array
    rotor: Array
    expected: Array
    widths: Array
    stribeck: bool = False
    alternatives: tuple[Alternative, ...] = field(default=())

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
            raise ValueError("unit and widths hold numbers that are not above zero, expected standard deviations")

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return self.geometry.n_joints

    @property
    def geometries(self) -> tuple[Geometry, ...]:
        """Its geometry, then those of the alternatives."""
        return (self.geometry, *(each.geometry for each in self.alternatives[1:]))

    @property
    def steps(self) -> int:
        """Numbers of the geometry that are learnt: none where it is fixed."""
        return len(self.widths)

    @property
    def place(self) -> NDArray[np.int64]:
        """Place in the chain of each joint of the data, (n,)."""
        return np.argsort(self.order)


def arm_of_robot(robot: RigidBody, gravity: bool = True, prior: Prior = "urdf", mode: GeometryMode = "fixed") -> Arm:
    """The arm of a URDF before any samples: its masses expected within a tenth of the URDF's, or within all of them if
    the prior is "zero", its geometry as `mode` says.

    Raise ValueError for a URDF without masses whose prior is "urdf".
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
        np.zeros(robot.n_joints),
        np.zeros(steps),
        widths_of(geometry)[:steps],
    )


def widths_of(geometry: Geometry) -> Array:
    """How far a unit's geometry may lie from that of its type, standard deviations, (g,) rad and m.

    Axes of two units, or of a unit and its URDF, lie within 0.005 rad and 0.003 m of each other, and their bases lean
    by 0.02 rad. Machining leaves less, but what an earlier posterior says of single numbers leaves out what is known
    only of several together. These and `WIDTHS.unit` of `lipcore.arm.problem` were tuned on simulated arms (50 and 51
    of `benchmarks/studies/learnt_arm.py transfer`): a fifth of it ended at times in a poor optimum that takes part of
    the torque for noise.
    """
    widths = np.where(geometry.turns, 0.005, 0.003)
    widths[: geometry.screws[0]] = 0.02
    return widths


def unit_of(robot: RigidBody, rotor: float) -> Array:
    """Usual size of a URDF's parameters, (11 n,): m_i, m_i ℓ and m_i ℓ² for mass, first moment and inertia of a body,
    in the order of the data; rotor: kg·m². A link without mass in the URDF may still have 2 % of the arm's.
    """
    mass = robot.parameters()[:, 0]
    total = float(mass.sum())
    scale = np.maximum(mass, 0.02 * total) if total > 0 else np.ones(robot.n_joints)
    powers = robot.length() ** np.array(KINDS)
    return np.concatenate([(scale[:, None] * powers).reshape(-1), np.full(robot.n_joints, rotor)])


def unit_anywhere(torque: float, joints: int) -> Array:
    """Usual size of the parameters of an arm of which only its largest torque, N·m, is known: (11 n,).

    The mass that makes this torque at a lever of 0.3 m, and what it has about such a lever.
    """
    lever = 0.3
    mass = max(torque, 1e-3) / (9.81 * lever)
    body = mass * np.array([1.0, lever, 2 * lever**2])[list(KINDS)]
    return np.concatenate([np.tile(body, joints), np.full(joints, ROTOR_SHARE * mass)])


ROTOR_SHARE = 0.03
"""Rotor inertia expected, m² times the mass of an arm's heaviest body."""


def chain(robot: RigidBody | None, joints: int) -> NDArray[np.int64]:
    """The data's joint at each place of the chain, (n,): as the data have them, where no URDF says otherwise."""
    return np.arange(joints) if robot is None else np.argsort(robot.order)


def in_chain(values: Array, order: Sequence[int] | NDArray[np.int64]) -> Array:
    """Columns in the order of the data, (N, n), from base to tip."""
    return np.ascontiguousarray(values[:, order])

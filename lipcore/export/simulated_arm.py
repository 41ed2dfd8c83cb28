"""An arm as simulators describe it: rigid bodies, rotors, viscous and Coulomb friction, shared by URDF and MJCF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from lipcore.data.samples import Array
from lipcore.files.entries import Chain, Inertia
from lipcore.kernels.fast.arm import arm_torques
from lipcore.kernels.geometry import Geometry, rotation_of, skew


@dataclass(frozen=True)
class ArmJoints:
    """The n joints of an arm without their poses, base to tip, each array (n,)."""

    names: tuple[str, ...]
    lower: Array
    """Min positions, rad (m)."""
    upper: Array
    """Max positions, rad (m)."""
    velocity: Array
    """Max speeds, rad/s (m/s)."""
    viscous: Array
    """N·m·s/rad (N·s/m)."""
    coulomb: Array
    """N·m (N)."""
    offset: Array
    """N·m (N)."""
    rotor: Array
    """kg·m² (kg)."""
    undetermined: tuple[tuple[str, ...], ...] = ()
    """Names of unidentifiable parameters of each joint and its body."""

    def __post_init__(self) -> None:
        n = len(self.names)
        for index, name in enumerate(self.names):
            if not name or not name.isprintable() or name in self.names[:index]:
                raise ValueError(f"names[{index}] is {name!r}, expected printable names that differ")
        for name in ("lower", "upper", "velocity", "viscous", "coulomb", "offset", "rotor"):
            value = getattr(self, name)
            if value.shape != (n,) or not np.isfinite(value).all():
                raise ValueError(f"{name} is {value}, expected {n} finite numbers")
        if (self.lower > self.upper).any():
            raise ValueError(f"lower is {self.lower}, expected at most upper, {self.upper}")


@dataclass(frozen=True)
class SimulatedArm:
    """An arm of n joints, base to tip. Raise ValueError for inconsistent sizes and a mass that is not positive."""

    geometry: Geometry
    bodies: Array
    """Ten parameters of each body about its joint's frame, (n, 10)."""
    joints: ArmJoints
    order: Array
    """The data's joint at each place of the chain, (n,)."""
    notes: tuple[str, ...] = ()
    """Comments about the whole arm."""

    def __post_init__(self) -> None:
        n, names = self.geometry.n_joints, self.joints.names
        if self.bodies.shape != (n, 10) or len(names) != n:
            raise ValueError(f"bodies has shape {self.bodies.shape} and joints {len(names)} names, expected {n} each")
        for joint, mass in zip(names, self.bodies[:, 0], strict=True):
            if not mass > 0:
                raise ValueError(f"the mass that joint {joint!r} moves is {mass:g} kg, expected more than zero")

    @classmethod
    def of_parameters(
        cls,
        parameters: Mapping[str, Any],
        joint_names: Sequence[str],
        training_range: Mapping[str, Mapping[str, Sequence[float]]],
    ) -> SimulatedArm:
        """Return the arm of the `parameters` in a version's manifest, with its physically possible bodies.

        joint_names and training_range: the manifest's, in the order of the data. Raise ValueError for a model without
        rigid bodies.
        """
        if "inertia" not in parameters:
            raise ValueError("the model has no rigid bodies, so no masses: expected the estimator 'rigid-body'")
        arm, inertia = msgspec.convert(parameters["geometry"], Chain), msgspec.convert(parameters["inertia"], Inertia)
        friction, ranges, order = parameters["friction"], training_range, arm.order

        def chain(values: Any) -> Array:
            return np.asarray(values, np.float64)[order]

        undetermined = tuple(
            (*place.undetermined, *inertia.bodies[joint].undetermined)
            for place, joint in zip(arm.joints, order, strict=True)
        )
        joints = ArmJoints(
            names=tuple(joint_names[joint] for joint in order),
            lower=chain(ranges["q"]["min"]),
            upper=chain(ranges["q"]["max"]),
            velocity=chain(np.abs([ranges["dq"]["min"], ranges["dq"]["max"]]).max(axis=0)),
            viscous=chain(friction["viscous"]["mean"]),
            coulomb=chain(friction["coulomb"]["mean"]),
            offset=chain(friction["offset"]["mean"]),
            rotor=chain(parameters["rotor"]["mean"]),
            undetermined=undetermined,
        )
        off = ", ".join(f"{value:.2g}" for value in chain(inertia.plausible_deviation))
        note = f"Torque of these bodies differs from the learnt torque by {off} N·m (N), root mean square, base to tip."
        return cls(arm.geometry(plausible=True), inertia.plausible()[order], joints, np.asarray(order), (note,))

    def bodies_torque(self, motions: Array) -> Array:
        """Return the torque of bodies and rotors at N motions (N, 3, n), in the order of the data: (N, n) N·m (N)."""
        out = np.zeros((len(motions), len(self.order)))
        geometry, order = self.geometry, self.order.astype(np.int64)
        arm_torques(geometry.constants, geometry.gravity, np.ascontiguousarray(self.bodies), order, motions, out)
        out[:, order] += np.maximum(self.joints.rotor, 0.0) * motions[:, 2, order]
        return out

    def friction_torque(self, dq: Array, sign: Array) -> Array:
        """Return viscous and Coulomb friction, (N, n) N·m (N). dq, sign: (N, n), in the order of the data."""
        viscous, coulomb = np.zeros((2, len(self.order)))
        viscous[self.order] = np.maximum(self.joints.viscous, 0.0)
        coulomb[self.order] = np.maximum(self.joints.coulomb, 0.0)
        return np.asarray(viscous * dq + coulomb * sign)

    def offset_torque(self) -> Array:
        """Return the learnt constant torque, (n,) N·m (N), in the order of the data."""
        offset = np.zeros(len(self.order))
        offset[self.order] = self.joints.offset
        return offset


def inertia_at_centre(body: Array) -> tuple[Array, Array]:
    """Return the centre of mass (3,) m of ten parameters, and the inertia about it, (3, 3) kg·m²."""
    mass, centre = float(body[0]), body[1:4] / body[0]
    arm = skew(centre)
    xx, xy, yy, xz, yz, zz = body[4:]
    return centre, np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) + mass * arm @ arm


def upright(gravity: Array) -> Array:
    """Return the shortest turn of the base after which gravity points down the root's z axis; none without gravity."""
    length = float(np.linalg.norm(gravity))
    if length == 0.0:
        return np.eye(3)
    down, goal = gravity / length, np.array([0.0, 0.0, -1.0])
    axis = np.cross(down, goal)
    sine, cosine = float(np.linalg.norm(axis)), float(down @ goal)
    if sine == 0.0:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    return rotation_of(axis / sine * np.arctan2(sine, cosine))

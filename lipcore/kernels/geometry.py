"""Geometry of the joint axes of a serial arm, or of several on one fixed base.

Every joint has a frame, placed in the frame of the joint before it. Its axis is a fixed vector of its own frame. Torque
depends on the axis of a joint relative to the one before: two turns and two shifts across the axis. A prismatic joint
has only the turns. The first joint has only its direction to gravity. A change of geometry is therefore a step in these
numbers,

    T_j ← T_j exp(ε_j),    ε_j = (turn about e1, about e2, shift along e1, along e2),    e1, e2 across the axis,

which is smooth everywhere. (Denavit–Hartenberg parameters are not: most arms have parallel axes, and for two parallel
axes the place of the common normal is undetermined. A small turn of an axis then moves it without bound.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import check_joint_types
from lipcore.data.samples import Array
from lipcore.kernels.fast.arm_recursion import ACROSS, AXIS, CONSTANTS, KIND, PLACE, ROOT, SCREWS, TURN
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import JointType

STANDARD_GRAVITY = 9.81
"""m/s², the value of Pinocchio."""


@dataclass(frozen=True)
class Geometry:
    """Geometry of n joints, from base to tip, arm after arm.

    Arms share only the fixed base, so the torque of an arm depends on its own joints alone.
    """

    joint_types: tuple[JointType, ...]
    """`revolute` or `prismatic`, (n,)."""
    rotation: Array
    """Axes of joint j's frame in the frame of joint j − 1 (of a root: in the base's frame) at q_j = 0, (n, 3, 3)."""
    translation: Array
    """Origin of joint j's frame in the same frame, (n, 3) m."""
    axis: Array
    """Unit vectors of the axes in the joints' own frames, (n, 3)."""
    gravity: Array
    """Gravity in the base's frame, (3,) m/s²; zero if torques do not contain it."""
    roots: tuple[int, ...] = (0,)
    """First joint of each arm, rising from 0."""

    def __post_init__(self) -> None:
        check_joint_types(self.joint_types)
        n = len(self.joint_types)
        for name, shape in (("rotation", (n, 3, 3)), ("translation", (n, 3)), ("axis", (n, 3)), ("gravity", (3,))):
            value = getattr(self, name)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"{name} has shape {value.shape}, expected finite numbers of shape {shape}")
        if list(self.roots) != sorted({0, *self.roots}) or self.roots[-1] >= n:
            raise ValueError(f"roots is {self.roots}, expected rising joints from 0 to {n - 1} that begin with 0")
        if not np.allclose(self.rotation @ self.rotation.mT, np.eye(3), atol=1e-6):
            raise ValueError("rotation contains a matrix that is not a rotation")
        if not np.allclose(np.linalg.norm(self.axis, axis=1), 1.0, atol=1e-6):
            raise ValueError("axis contains a vector that is not of length one")

    @classmethod
    def from_robot(cls, robot: RigidBody, gravity: bool = True) -> Geometry:
        """Return the geometry of a URDF with its own frames and axes. gravity: whether torques contain gravity."""
        model = robot.model
        places, order = tuple(model.jointPlacements)[1:], np.argsort(robot.order)
        axes = np.array([_axis(model.joints[joint]) for joint in range(1, model.njoints)])
        return cls(
            tuple(robot.joint_types[joint] for joint in order),
            np.array([place.rotation for place in places]),
            np.array([place.translation for place in places]),
            axes,
            np.array(model.gravity.linear) if gravity else np.zeros(3),
            robot.roots,
        )

    @classmethod
    def joined(cls, arms: Sequence[Geometry]) -> Geometry:
        """Return several arms on one base. They have the gravity of the first."""
        return cls(
            tuple(kind for each in arms for kind in each.joint_types),
            np.concatenate([each.rotation for each in arms]),
            np.concatenate([each.translation for each in arms]),
            np.concatenate([each.axis for each in arms]),
            arms[0].gravity,
            (0, *accumulate(each.n_joints for each in arms[:-1])),
        )

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joint_types)

    @cached_property
    def arm_of(self) -> NDArray[np.int64]:
        """Index of each joint's arm, (n,)."""
        return np.searchsorted(self.roots, np.arange(self.n_joints), side="right") - 1

    @cached_property
    def arms(self) -> tuple[tuple[slice, slice, Geometry], ...]:
        """Joints of each arm, places of its numbers in a step, and its geometry."""
        out, first = [], 0
        for root, end in pairwise((*self.roots, self.n_joints)):
            joints, size = slice(root, end), sum(self.screws[root:end])
            types, frames = self.joint_types[joints], (self.rotation[joints], self.translation[joints])
            out.append((joints, slice(first, first + size), Geometry(types, *frames, self.axis[joints], self.gravity)))
            first += size
        return tuple(out)

    @cached_property
    def across(self) -> Array:
        """Two unit vectors across each joint's axis, in its own frame, (n, 2, 3)."""
        helper = np.eye(3)[np.abs(self.axis).argmin(axis=1)]
        first = np.cross(helper, self.axis)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        return np.stack([first, np.cross(self.axis, first)], axis=1)

    @property
    def screws(self) -> tuple[int, ...]:
        """Count of identifiable numbers of each joint: four, two if it is prismatic, two or none for a root."""
        first = 2 if np.any(self.gravity) else 0
        counts = [4 if kind == "revolute" else 2 for kind in self.joint_types]
        return tuple(first if joint in self.roots else count for joint, count in enumerate(counts))

    @property
    def size(self) -> int:
        """Number of the geometry's numbers, g."""
        return sum(self.screws)

    @property
    def turns(self) -> Array:
        """Mask of the numbers that are angles in rad, (g,); the others are lengths in m."""
        return np.concatenate([np.arange(count) < 2 for count in self.screws]).astype(bool)

    @cached_property
    def constants(self) -> Array:
        """The geometry in the layout of `kernels.fast.arm_recursion`, (n, CONSTANTS)."""
        n = self.n_joints
        out = np.zeros((n, CONSTANTS))
        out[:, TURN:PLACE] = (self.rotation[:, None] @ self.turn_parts).reshape(n, -1)
        out[:, PLACE:AXIS] = self.translation
        out[:, AXIS:ACROSS] = (self.rotation @ self.axis[..., None])[..., 0]
        out[:, ACROSS:KIND] = (self.across @ self.rotation.mT).reshape(n, -1)
        out[:, KIND] = [kind == "prismatic" for kind in self.joint_types]
        out[:, SCREWS] = self.screws
        out[:, ROOT] = np.array(self.roots)[self.arm_of]
        return out

    def moved(self, step: Array) -> Geometry:
        """Return the geometry after a step, (g,) rad and m."""
        numbers = self.numbers(step)[:, None]
        turn, shift = (numbers[..., part] @ self.across for part in (slice(0, 2), slice(2, 4)))
        translation = self.translation + (self.rotation @ shift.mT)[..., 0]
        return replace(self, rotation=self.rotation @ rotation_of(turn[:, 0]), translation=translation)

    def numbers(self, step: Array) -> Array:
        """Return a step as four numbers of each joint, (n, 4); zero for those that do not exist."""
        numbers = np.zeros((self.n_joints, 4))
        numbers[self._counted] = step
        return numbers

    @cached_property
    def turn_parts(self) -> Array:
        """Matrices M, (n, 3, 3, 3), with M₀ + M₁ sin q + M₂ cos q = exp(q axis×).

        For a prismatic joint the sum is the identity.
        """
        along, one = self.axis[:, :, None] * self.axis[:, None], np.eye(3)
        parts = np.stack([along, skew(self.axis), one - along], axis=1)
        for j, kind in enumerate(self.joint_types):
            if kind == "prismatic":
                parts[j] = one, 0 * one, 0 * one
        return parts

    def towards(self, other: Geometry) -> Array:
        """Return the step, (g,), to another geometry of the same joints, to first order in their difference."""
        turn = rotation_vector_of(self.rotation.mT @ other.rotation)
        return self._step(turn, self.rotation.mT @ (other.translation - self.translation)[..., None])

    def shifts(self) -> Array:
        """Return the position of each axis across itself, relative to the frame before, (g,) m; zero for turns."""
        return self._step(np.zeros_like(self.translation), self.rotation.mT @ self.translation[..., None])

    def _step(self, turn: Array, shift: Array) -> Array:
        """Return the numbers that describe turns (n, 3) and shifts (n, 3, 1) of the joints' frames, in these frames."""
        numbers = np.concatenate([self.across @ turn[..., None], self.across @ shift], axis=1)[..., 0]
        return np.asarray(numbers[self._counted])

    @cached_property
    def _counted(self) -> NDArray[np.bool_]:
        """Mask of the numbers of each joint that exist among its four, (n, 4)."""
        return np.arange(4) < np.reshape(self.screws, (-1, 1))

    def canonical(self) -> Geometry:
        """Return the same arm with each frame where its axis comes closest to the frame before.

        The first frame of each arm is at the base. Torque does not depend on the position of a frame along its axis.
        This applies to revolute joints only: a prismatic joint's frame stays at the origin of the one before.
        """
        translation, moved = self.translation.copy(), np.zeros(3)
        for j, kind in enumerate(self.joint_types):
            place = translation[j] if j in self.roots else translation[j] - moved
            if j in self.roots or kind == "prismatic":
                kept = np.zeros(3)
            else:
                axis = self.rotation[j] @ self.axis[j]
                kept = place - axis * (axis @ place)
            # the movement of this joint's frame, in the frame's own coordinates
            moved = self.rotation[j].T @ (kept - place)
            if kind == "revolute":
                moved = self.axis[j] * (self.axis[j] @ moved)
            translation[j] = kept
        return replace(self, translation=translation)

    def placements(self, q: Array) -> tuple[Array, Array]:
        """Return rotations (n, 3, 3) and origins (n, 3) m of all joint frames in the base's frame at q, (n,)."""
        turn, place, turns, places = np.eye(3), np.zeros(3), [], []
        for j, kind in enumerate(self.joint_types):
            if j in self.roots:
                turn, place = np.eye(3), np.zeros(3)
            place, turn = place + turn @ self.translation[j], turn @ self.rotation[j]
            if kind == "revolute":
                turn = turn @ rotation_of(self.axis[j] * q[j])
            else:
                place = place + turn @ self.axis[j] * q[j]
            turns.append(turn)
            places.append(place)
        return np.array(turns), np.array(places)


def skew(vector: Array) -> Array:
    """Return the matrix of vector × …, (…, 3) to (…, 3, 3)."""
    out = np.zeros((*vector.shape, 3))
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -z, y, -x
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = z, -y, x
    return out


def rotation_of(turn: Array) -> Array:
    """Return the rotation by the vector `turn`, rad: exp(turn×), (…, 3) to (…, 3, 3), by Rodrigues' formula."""
    angle = np.linalg.norm(turn, axis=-1)[..., None, None]
    unit = skew(turn / np.where(angle[..., 0] > 0, angle[..., 0], 1.0))
    return np.asarray(np.eye(3) + np.sin(angle) * unit + (1 - np.cos(angle)) * unit @ unit)


def rotation_vector_of(rotation: Array) -> Array:
    """Return the rotation vector of a rotation, (…, 3, 3) to (…, 3) rad, shorter than π; inverts `rotation_of`."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - serving does without it

    return np.asarray(Rotation.from_matrix(rotation).as_rotvec())


def rotation_to_axis(axis: Array) -> Array:
    """Return a rotation with the unit vector `axis` as third column, (3, 3)."""
    third = np.asarray(axis, np.float64)
    first = np.cross(np.eye(3)[int(np.abs(third).argmin())], third)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(third, first), third], axis=1)


def _axis(joint: object) -> Array:
    """Return the unit vector of the axis of a Pinocchio joint, in its own frame."""
    name = joint.shortname()  # type: ignore[attr-defined]
    for place, letter in enumerate("XYZ"):
        if name.endswith(letter):
            return np.asarray(np.eye(3)[place])
    data = joint.createData()  # type: ignore[attr-defined]
    q = np.zeros(joint.nq) if joint.nq == 1 else np.array([1.0, 0.0])  # type: ignore[attr-defined]
    joint.calc(data, q)  # type: ignore[attr-defined]
    screw = np.asarray(data.S).reshape(6)
    vector = screw[3:] if np.any(screw[3:]) else screw[:3]
    return np.asarray(vector / np.linalg.norm(vector))

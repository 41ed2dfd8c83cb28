"""Contents that URDF and MJCF share: comments, sizes of drawn shapes, and numbers as text."""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree import ElementTree

import numpy as np

from lipcore.data.samples import Array
from lipcore.export.sheet import Sheet
from lipcore.export.simulated_arm import SimulatedArm
from lipcore.kernels.geometry import STANDARD_GRAVITY, Geometry

Element = ElementTree.Element

BASE = "base"
HEADER_COMMENTS = (
    "Learnt from torque by LIPServe.",
    "Torque does not distinguish an arm from its mirror image, nor fix the place of a frame along its axis.",
    "Limits of position and velocity are the range of the training, not those of the drives.",
)


def arm_comments(arm: SimulatedArm, own: Sequence[str]) -> list[str]:
    """Return the comments about the whole arm. own: those of the format."""
    return [*HEADER_COMMENTS, *own, *_gravity_comments(arm.geometry), *arm.notes]


def _gravity_comments(geometry: Geometry) -> list[str]:
    """Return comments about gravity and the orientation of the base."""
    strength = float(np.linalg.norm(geometry.gravity))
    if strength == 0.0:
        return ["Torque was measured without gravity: the orientation of the base is unknown."]
    if abs(strength - STANDARD_GRAVITY) > 1e-9:
        return [f"Gravity is {strength!r} m/s² here: set it in the simulator."]
    return []


def joint_comments(arm: SimulatedArm, k: int, sheet: Sheet | None, offset: str = "is left out") -> list[str]:
    """Return the comments of a joint: terms left out, parameters that torque does not determine, torque errors.

    offset: what became of the constant torque.
    """
    joints = arm.joints
    terms = {"damping": joints.viscous[k], "friction": joints.coulomb[k], "rotor": joints.rotor[k]}
    notes = [f"learnt {key} is {value_text(value)}, written as 0" for key, value in terms.items() if value < 0]
    notes.append(f"offset torque {value_text(joints.offset[k])} {offset}")
    if joints.undetermined and joints.undetermined[k]:
        notes.append(f"not identifiable from torque: {', '.join(joints.undetermined[k])}")
    return notes if sheet is None else [*notes, sheet.joint_note(k)]


def ball_radius(mass: float) -> float:
    """Return the radius of an aluminium ball of a mass, m."""
    return float((0.75 * mass / (np.pi * 2700.0)) ** (1 / 3))


def line_radius(reach: Array) -> float:
    """Return the radius of the lines between joints, m. reach: of `reach_of`."""
    return max(0.02 * float(reach[0]), 1e-3)


def reach_of(arm: SimulatedArm) -> Array:
    """Return a bound on the distance from each joint to the centres of mass of the bodies that it moves, (n,) m."""
    steps = np.linalg.norm(arm.geometry.translation, axis=1)
    slides = [kind == "prismatic" for kind in arm.geometry.joint_types]
    steps = steps + np.maximum(np.abs(arm.joints.lower), np.abs(arm.joints.upper)) * slides
    out, beyond = np.zeros(len(steps)), 0.0
    for k in range(len(steps) - 1, -1, -1):
        beyond = max(float(np.linalg.norm(arm.bodies[k, 1:4])) / arm.bodies[k, 0], beyond)
        out[k] = beyond
        beyond = 0.0 if k in arm.geometry.roots else beyond + steps[k]
    return out


def add_comments(element: Element, texts: Sequence[str]) -> None:
    """Append comments to an element."""
    for text in texts:
        element.append(ElementTree.Comment(f" {text.replace('--', '- -')} "))


def join_values(values: Array) -> str:
    """Return numbers that read back exactly."""
    return " ".join(value_text(value) for value in values)


def value_text(value: float) -> str:
    """Return a number that reads back exactly."""
    return repr(float(value) + 0.0)

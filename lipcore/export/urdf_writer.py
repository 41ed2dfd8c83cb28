"""A URDF of an arm with learnt geometry: one link a joint, with its mass, its friction and its rotor.

URDF has no tag for rotor inertia: it is written in a `<transmission>`, as Drake reads it. The torque of a simulator
that ignores it lacks rotor · ddq. Offset torque is written as a comment. Friction of slow joints only is left out. If
gravity does not point down the base's z axis, a fixed joint from `world` to `base` turns the base.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import msgspec
import numpy as np

from lipcore.data.samples import Array
from lipcore.files.entries import Chain, Inertia
from lipcore.kernels.geometry import STANDARD_GRAVITY, Geometry, rotation_of, rotation_to_axis, skew

Element = ElementTree.Element

ROOT, BASE = "world", "base"
HEADER_COMMENTS = (
    "Learnt from torque by LIPServe.",
    "Torque does not distinguish an arm from its mirror image, nor fix the place of a frame along its axis.",
    "Limits of position and velocity are the range of the training, not those of the drives.",
    "No torque limit is known: effort is set far above what the arm needs.",
    "Rotor inertia is in the transmissions, as drake:rotor_inertia; offset torque is in comments.",
)


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


def urdf_text(
    geometry: Geometry, bodies: Array, joints: ArmJoints, name: str = "arm", notes: Sequence[str] = ()
) -> str:
    """Return the URDF of an arm.

    bodies: (n, 10), ten parameters each about its joint's frame, base to tip; name: the robot's; notes: comments at its
    beginning.

    With gravity (0, 0, −|g|) in the frame of the root, recursive Newton–Euler on the URDF, plus rotor · ddq and
    friction, is the torque of the arm. Negative friction, which no simulator accepts, is written as zero. Raise
    ValueError for a mass that is not positive and for inconsistent sizes.
    """
    n = geometry.n_joints
    if bodies.shape != (n, 10) or len(joints.names) != n:
        raise ValueError(f"bodies has shape {bodies.shape} and joints {len(joints.names)} names, expected {n} each")
    for joint, mass in zip(joints.names, bodies[:, 0], strict=True):
        if not mass > 0:
            raise ValueError(f"the mass that joint {joint!r} moves is {mass:g} kg, expected more than zero")
    robot = Element("robot", {"name": name, "xmlns:drake": "http://drake.mit.edu"})
    _comments(robot, [*HEADER_COMMENTS, *_gravity_comments(geometry), *notes])
    parent, reach = BASE, _reach(geometry, bodies, joints)
    line = max(0.02 * float(reach[0]), 1e-3)
    upright = _upright(geometry.gravity)
    if not np.array_equal(upright, np.eye(3)):
        ElementTree.SubElement(robot, "link", name=ROOT)
        fixed = _unlike(f"{ROOT}_to_{BASE}", joints.names)
        _joint(robot, fixed, "fixed", ROOT, BASE, upright, np.zeros(3))
    _link(robot, BASE, None, geometry.translation[0], line)
    effort = _effort(bodies, joints, reach)
    for k, joint in enumerate(joints.names):
        child = f"{joint}_link"
        made = _joint(
            robot, joint, geometry.joint_types[k], parent, child, geometry.rotation[k], geometry.translation[k]
        )
        _moving(made, geometry.axis[k], joints, k, float(effort[k]))
        _link(robot, child, bodies[k], geometry.translation[k + 1] if k + 1 < n else None, line)
        parent = child
    for joint, rotor in zip(joints.names, joints.rotor, strict=True):
        _transmission(robot, joint, float(rotor))
    ElementTree.indent(robot)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"


def urdf_of_parameters(
    parameters: Mapping[str, Any],
    joint_names: Sequence[str],
    training_range: Mapping[str, Mapping[str, Sequence[float]]],
    name: str = "arm",
) -> str:
    """Return the URDF of the `parameters` in a version's manifest, with its physically possible bodies.

    joint_names and training_range: the manifest's, in the order of the data. Raise ValueError for a model without rigid
    bodies.
    """
    if "inertia" not in parameters:
        raise ValueError("the model has no rigid bodies, so no masses: a URDF needs the estimator 'rigid-body'")
    arm, inertia = msgspec.convert(parameters["geometry"], Chain), msgspec.convert(parameters["inertia"], Inertia)
    friction, ranges, order = parameters["friction"], training_range, arm.order
    rotor = parameters["rotor"]["mean"]

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
        rotor=chain(rotor),
        undetermined=undetermined,
    )
    off = ", ".join(f"{value:.2g}" for value in chain(inertia.plausible_deviation))
    notes = [f"Torque of these bodies differs from the learnt torque by {off} N·m (N), root mean square, base to tip."]
    return urdf_text(arm.geometry(plausible=True), inertia.plausible()[order], joints, name, notes)


def rpy(rotation: Array) -> Array:
    """Return roll, pitch and yaw (3,) rad of a rotation Rz(yaw) Ry(pitch) Rx(roll), exact even at a pitch of ± 90°."""
    (a, _, _), (b, _, _), (c, _, _) = rotation
    yaw = np.arctan2(b, a)
    sin, cos = np.sin(yaw), np.cos(yaw)
    x, y = rotation[0], rotation[1]
    roll = np.arctan2(sin * x[2] - cos * y[2], cos * y[1] - sin * x[1])
    return np.array([roll, np.arctan2(-c, np.hypot(a, b)), yaw])


def _upright(gravity: Array) -> Array:
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


def _gravity_comments(geometry: Geometry) -> list[str]:
    strength = float(np.linalg.norm(geometry.gravity))
    if strength == 0.0:
        return ["Torque was measured without gravity: the orientation of the base is unknown."]
    if abs(strength - STANDARD_GRAVITY) > 1e-9:
        return [f"Gravity is {strength!r} m/s² here: set it in the simulator."]
    return []


def _reach(geometry: Geometry, bodies: Array, joints: ArmJoints) -> Array:
    """Return a bound on the distance from each joint to the centres of mass of the bodies that it moves, (n,) m."""
    steps = np.linalg.norm(geometry.translation, axis=1)
    slides = [kind == "prismatic" for kind in geometry.joint_types]
    steps = steps + np.maximum(np.abs(joints.lower), np.abs(joints.upper)) * slides
    out, beyond = np.zeros(len(steps)), 0.0
    for k in range(len(steps) - 1, -1, -1):
        arm = float(np.linalg.norm(bodies[k, 1:4])) / bodies[k, 0]
        beyond = max(arm, beyond)
        out[k] = beyond
        beyond += steps[k]
    return out


def _effort(bodies: Array, joints: ArmJoints, reach: Array) -> Array:
    """Return a limit of torque that does not bind, (n,) N·m (N): the drives' limits are unknown."""
    carried = np.cumsum(bodies[::-1, 0])[::-1] * STANDARD_GRAVITY
    lever = np.maximum(reach, 1.0)
    friction = np.abs(joints.viscous) * joints.velocity + np.abs(joints.coulomb) + np.abs(joints.offset)
    return 10.0 * (carried * lever + friction)  # far above the torques of the training


def _joint(
    robot: Element, name: str, kind: str, parent: str, child: str, rotation: Array, translation: Array
) -> Element:
    joint = ElementTree.SubElement(robot, "joint", name=name, type=kind)
    _origin(joint, translation, rotation)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    return joint


def _moving(joint: Element, axis: Array, joints: ArmJoints, k: int, effort: float) -> None:
    """Write axis, limits and friction of a joint."""
    ElementTree.SubElement(joint, "axis", xyz=_texts(axis))
    limits = {"lower": joints.lower[k], "upper": joints.upper[k], "velocity": joints.velocity[k], "effort": effort}
    ElementTree.SubElement(joint, "limit", {key: _text(value) for key, value in limits.items()})
    terms = {"damping": float(joints.viscous[k]), "friction": float(joints.coulomb[k])}
    ElementTree.SubElement(joint, "dynamics", {key: _text(max(value, 0.0)) for key, value in terms.items()})
    notes = [f"learnt {key} is {_text(value)}" for key, value in terms.items() if value < 0]
    notes += [f"offset torque {_text(joints.offset[k])}, rotor inertia {_text(joints.rotor[k])}"]
    if joints.undetermined and joints.undetermined[k]:
        notes.append(f"not identifiable from torque: {', '.join(joints.undetermined[k])}")
    _comments(joint, notes)


def _link(robot: Element, name: str, body: Array | None, end: Array | None, line: float) -> None:
    """Write a link with its mass, a sphere at its centre of mass, and a line to the frame of the next joint."""
    link = ElementTree.SubElement(robot, "link", name=name)
    if body is not None:
        mass, centre = float(body[0]), body[1:4] / body[0]
        inertial = ElementTree.SubElement(link, "inertial")
        _origin(inertial, centre)
        ElementTree.SubElement(inertial, "mass", value=_text(mass))
        arm = skew(centre)
        xx, xy, yy, xz, yz, zz = body[4:]
        about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) + mass * arm @ arm
        entries = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
        ElementTree.SubElement(inertial, "inertia", {key: _text(about[at]) for key, at in entries.items()})
        sphere = _visual(link, centre)  # the radius of an aluminium ball of this mass
        ElementTree.SubElement(sphere, "sphere", radius=f"{(0.75 * mass / (np.pi * 2700.0)) ** (1 / 3):.4f}")
    length = 0.0 if end is None else float(np.linalg.norm(end))
    if end is not None and length > line:
        cylinder = _visual(link, 0.5 * end, rotation_to_axis((end / length).tolist()))
        ElementTree.SubElement(cylinder, "cylinder", radius=f"{line:.4f}", length=f"{length:.4f}")


def _visual(link: Element, place: Array, rotation: Array | None = None) -> Element:
    visual = ElementTree.SubElement(link, "visual")
    _origin(visual, place, rotation)
    return ElementTree.SubElement(visual, "geometry")


def _transmission(robot: Element, joint: str, rotor: float) -> None:
    """Write a drive without a gear: the inertia of its rotor is that at the joint."""
    made = ElementTree.SubElement(robot, "transmission", name=f"{joint}_transmission")
    ElementTree.SubElement(made, "type").text = "transmission_interface/SimpleTransmission"
    held = ElementTree.SubElement(made, "joint", name=joint)
    ElementTree.SubElement(held, "hardwareInterface").text = "hardware_interface/EffortJointInterface"
    actuator = ElementTree.SubElement(made, "actuator", name=f"{joint}_motor")
    ElementTree.SubElement(actuator, "mechanicalReduction").text = "1"
    ElementTree.SubElement(actuator, "drake:gear_ratio", value="1")
    ElementTree.SubElement(actuator, "drake:rotor_inertia", value=_text(max(rotor, 0.0)))


def _origin(element: Element, place: Array, rotation: Array | None = None) -> None:
    turn = np.zeros(3) if rotation is None else rpy(rotation)
    ElementTree.SubElement(element, "origin", xyz=_texts(place), rpy=_texts(turn))


def _comments(element: Element, texts: Sequence[str]) -> None:
    for text in texts:
        element.append(ElementTree.Comment(f" {text.replace('--', '- -')} "))


def _unlike(name: str, others: Sequence[str]) -> str:
    """Return the name, extended until it is none of the others."""
    while name in others:
        name += "_"
    return name


def _texts(values: Array) -> str:
    return " ".join(_text(value) for value in values)


def _text(value: float) -> str:
    return repr(float(value) + 0.0)

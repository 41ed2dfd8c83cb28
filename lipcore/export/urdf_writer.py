"""A URDF of an arm: one link a joint, with its mass, its friction and its rotor.

URDF has no tag for rotor inertia: it is written in a `<transmission>`, as Drake reads it. The torque of a simulator
that ignores it lacks rotor · ddq. Terms that a URDF cannot express are left out; comments have their largest torque. If
gravity does not point down the base's z axis, a fixed joint from `world` to `base` turns the base.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from xml.etree import ElementTree

import numpy as np

from lipcore.data.samples import Array
from lipcore.export.description import (
    BASE,
    Element,
    add_comments,
    arm_comments,
    ball_radius,
    join_values,
    joint_comments,
    line_radius,
    reach_of,
    value_text,
)
from lipcore.export.sheet import Sheet
from lipcore.export.simulated_arm import ArmJoints, SimulatedArm, inertia_at_centre, upright
from lipcore.kernels.geometry import STANDARD_GRAVITY, rotation_to_axis

ROOT = "world"
COMMENTS = (
    "No torque limit is known: effort is set far above what the arm needs.",
    "Rotor inertia is in the transmissions, as drake:rotor_inertia.",
)


def urdf_text(arm: SimulatedArm, name: str = "arm", sheet: Sheet | None = None) -> str:
    """Return the URDF of an arm. name: the robot's; sheet: origin and self-test, as comments.

    With gravity (0, 0, −|g|) in the frame of the root, recursive Newton–Euler on the URDF, plus rotor · ddq and
    friction, is the torque of the arm. Negative friction, which no simulator accepts, is written as zero.
    """
    geometry, bodies, joints = arm.geometry, arm.bodies, arm.joints
    n = geometry.n_joints
    robot = Element("robot", {"name": name, "xmlns:drake": "http://drake.mit.edu"})
    add_comments(robot, arm_comments(arm, COMMENTS))
    parent, reach = BASE, reach_of(arm)
    line = line_radius(reach)
    turn = upright(geometry.gravity)
    if not np.array_equal(turn, np.eye(3)):
        ElementTree.SubElement(robot, "link", name=ROOT)
        fixed = _unlike(f"{ROOT}_to_{BASE}", joints.names)
        _joint(robot, fixed, "fixed", ROOT, BASE, turn, np.zeros(3))
    _link(robot, BASE, None, [geometry.translation[root] for root in geometry.roots], line)
    effort = _effort(bodies, joints, reach)
    for k, joint in enumerate(joints.names):
        parent = BASE if k in geometry.roots else parent
        child = f"{joint}_link"
        made = _joint(
            robot, joint, geometry.joint_types[k], parent, child, geometry.rotation[k], geometry.translation[k]
        )
        _moving(made, geometry.axis[k], joints, k, float(effort[k]))
        add_comments(made, joint_comments(arm, k, sheet))
        following = [] if k + 1 in (*geometry.roots, n) else [geometry.translation[k + 1]]
        _link(robot, child, bodies[k], following, line)
        parent = child
    for joint, rotor in zip(joints.names, joints.rotor, strict=True):
        _transmission(robot, joint, float(rotor))
    if sheet is not None:
        add_comments(robot, [json.dumps(sheet.about), json.dumps({"self_test": sheet.self_test})])
    ElementTree.indent(robot)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"


def rpy(rotation: Array) -> Array:
    """Return roll, pitch and yaw (3,) rad of a rotation Rz(yaw) Ry(pitch) Rx(roll), exact even at a pitch of ± 90°."""
    (a, _, _), (b, _, _), (c, _, _) = rotation
    yaw = np.arctan2(b, a)
    sin, cos = np.sin(yaw), np.cos(yaw)
    x, y = rotation[0], rotation[1]
    roll = np.arctan2(sin * x[2] - cos * y[2], cos * y[1] - sin * x[1])
    return np.array([roll, np.arctan2(-c, np.hypot(a, b)), yaw])


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
    ElementTree.SubElement(joint, "axis", xyz=join_values(axis))
    limits = {"lower": joints.lower[k], "upper": joints.upper[k], "velocity": joints.velocity[k], "effort": effort}
    ElementTree.SubElement(joint, "limit", {key: value_text(value) for key, value in limits.items()})
    terms = {"damping": float(joints.viscous[k]), "friction": float(joints.coulomb[k])}
    ElementTree.SubElement(joint, "dynamics", {key: value_text(max(value, 0.0)) for key, value in terms.items()})


def _link(robot: Element, name: str, body: Array | None, ends: Sequence[Array], line: float) -> None:
    """Write a link with its mass, a sphere at its centre of mass, and lines to the frames of the next joints."""
    link = ElementTree.SubElement(robot, "link", name=name)
    if body is not None:
        mass, (centre, about) = float(body[0]), inertia_at_centre(body)
        inertial = ElementTree.SubElement(link, "inertial")
        _origin(inertial, centre)
        ElementTree.SubElement(inertial, "mass", value=value_text(mass))
        entries = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
        ElementTree.SubElement(inertial, "inertia", {key: value_text(about[at]) for key, at in entries.items()})
        ElementTree.SubElement(_visual(link, centre), "sphere", radius=f"{ball_radius(mass):.4f}")
    for end in ends:
        length = float(np.linalg.norm(end))
        if length > line:
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
    ElementTree.SubElement(actuator, "drake:rotor_inertia", value=value_text(max(rotor, 0.0)))


def _origin(element: Element, place: Array, rotation: Array | None = None) -> None:
    turn = np.zeros(3) if rotation is None else rpy(rotation)
    ElementTree.SubElement(element, "origin", xyz=join_values(place), rpy=join_values(turn))


def _unlike(name: str, others: Sequence[str]) -> str:
    """Return the name, extended until it is none of the others."""
    while name in others:
        name += "_"
    return name

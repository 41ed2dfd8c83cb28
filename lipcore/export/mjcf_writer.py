"""An MJCF of an arm for MuJoCo: one body a joint, with mass, rotor (armature), viscous and Coulomb friction.

`mj_inverse` plus Coulomb friction is the arm's torque if the option flag `frictionloss` is disabled. MuJoCo's own
Coulomb friction is a constraint, whose force depends on the acceleration, too. The offset of the torque is a bias of
the motor. Terms that a joint of MuJoCo cannot express are left out; comments have their largest torque. If gravity does
not point down the base's z axis, the body `base` is turned.
"""

from __future__ import annotations

import json
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
from lipcore.export.simulated_arm import SimulatedArm, inertia_at_centre, upright
from lipcore.kernels.geometry import rotation_vector_of
from lipcore.model.plausible import nearest_solid

COMMENTS = (
    "One motor a joint: its control is the torque, N·m (N). Its bias is minus the learnt offset of the torque.",
    "Geometry is drawn, it collides with nothing.",
    "Self-test: numbers selftest_q, _dq, _ddq, _tau, _model_tau, state by state. With the option flag frictionloss "
    "disabled, mj_inverse plus frictionloss · sign(dq) minus the motor's bias is selftest_tau; the torque of the model "
    "is selftest_model_tau.",
)
FRICTION_IMPEDANCE = "0.9999 0.9999 0.001"
"""Impedance of friction: MuJoCo's maximum. With the default, 0.9, friction grows with speed: at the last joint of a
Panda up to 0.3 rad/s, and a joint at rest slips."""
LEAST_SPREAD = 1e-12
"""Min second moment of a body about its centre of mass, kg·m². MuJoCo rejects moments of inertia below 1e-15."""


def mjcf_text(arm: SimulatedArm, name: str = "arm", sheet: Sheet | None = None) -> str:
    """Return the MJCF of an arm. name: the model's; sheet: origin and self-test, as custom text and numbers.

    Bodies that MuJoCo would reject are replaced by the nearest ones that it accepts; a comment has the difference.
    Negative friction and rotors are written as zero.
    """
    geometry, joints = arm.geometry, arm.joints
    root = Element("mujoco", model=name)
    add_comments(root, arm_comments(arm, COMMENTS))
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="true")
    strength = float(np.linalg.norm(geometry.gravity))
    ElementTree.SubElement(root, "option", gravity=join_values(np.array([0.0, 0.0, -strength])))
    default = ElementTree.SubElement(root, "default")
    ElementTree.SubElement(default, "geom", contype="0", conaffinity="0", density="0", group="1")
    if sheet is not None:
        _custom(root, sheet)
    line = line_radius(reach_of(arm))
    base = body = ElementTree.SubElement(ElementTree.SubElement(root, "worldbody"), "body", name=BASE)
    base.set("quat", _quaternion(upright(geometry.gravity)))
    for k, joint in enumerate(joints.names):
        body = base if k in geometry.roots else body
        _line(body, geometry.translation[k], line)
        place, turn = join_values(geometry.translation[k]), _quaternion(geometry.rotation[k])
        body = ElementTree.SubElement(body, "body", name=f"{joint}_link", pos=place, quat=turn)
        _inertial(body, arm.bodies[k])
        _joint(body, arm, k)
        add_comments(body, joint_comments(arm, k, sheet, "is in the motor"))
    actuators = ElementTree.SubElement(root, "actuator")
    for joint, offset in zip(joints.names, joints.offset, strict=True):
        motor = ElementTree.SubElement(actuators, "general", name=f"{joint}_motor", joint=joint)
        motor.attrib |= {"biastype": "affine", "biasprm": f"{value_text(-offset)} 0 0"}
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _custom(root: Element, sheet: Sheet) -> None:
    """Write origin and self-test. MuJoCo keeps both in the compiled model."""
    custom = ElementTree.SubElement(root, "custom")
    ElementTree.SubElement(custom, "text", name="lipserve", data=json.dumps(sheet.about))
    for name, rows in sheet.self_test.items():
        ElementTree.SubElement(custom, "numeric", name=f"selftest_{name}", data=join_values(np.ravel(rows)))


def _inertial(body: Element, parameters: Array) -> None:
    """Write mass, centre of mass and inertia about it, and a ball at the centre of mass."""
    solid = nearest_solid(parameters, LEAST_SPREAD)
    centre, about = inertia_at_centre(solid)
    pairs = (about[0, 0], about[1, 1], about[2, 2], about[0, 1], about[0, 2], about[1, 2])
    mass, place = value_text(solid[0]), join_values(centre)
    ElementTree.SubElement(body, "inertial", pos=place, mass=mass, fullinertia=join_values(np.array(pairs)))
    if shift := float(np.abs(solid - parameters).max()):
        add_comments(body, [f"moved by {shift:.2g} kg·m² to the nearest inertia that a body can have"])
    ElementTree.SubElement(body, "geom", type="sphere", pos=place, size=f"{ball_radius(float(solid[0])):.4f}")


def _joint(body: Element, arm: SimulatedArm, k: int) -> None:
    joints = arm.joints
    kind = "slide" if arm.geometry.joint_types[k] == "prismatic" else "hinge"
    terms = {"armature": joints.rotor[k], "damping": joints.viscous[k], "frictionloss": joints.coulomb[k]}
    values = {key: value_text(max(value, 0.0)) for key, value in terms.items()}
    if joints.lower[k] < joints.upper[k]:  # MuJoCo rejects a range of zero
        values["range"] = join_values(np.array([joints.lower[k], joints.upper[k]]))
    if joints.coulomb[k] > 0:
        values["solimpfriction"] = FRICTION_IMPEDANCE
    axis = join_values(arm.geometry.axis[k])
    ElementTree.SubElement(body, "joint", {"name": joints.names[k], "type": kind, "axis": axis, **values})


def _line(body: Element, end: Array, radius: float) -> None:
    """Write a line to the frame of the next joint, unless it is shorter than wide."""
    if float(np.linalg.norm(end)) > radius:
        both = join_values(np.concatenate([np.zeros(3), end]))
        ElementTree.SubElement(body, "geom", type="cylinder", fromto=both, size=f"{radius:.4f}")


def _quaternion(rotation: Array) -> str:
    """Return the quaternion w, x, y, z of a rotation."""
    turn = rotation_vector_of(rotation)
    angle = float(np.linalg.norm(turn))
    return join_values(np.array([np.cos(0.5 * angle), *(0.5 * np.sinc(0.5 * angle / np.pi) * turn)]))

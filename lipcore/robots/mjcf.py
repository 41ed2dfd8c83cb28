"""Robots in MuJoCo's format MJCF, converted to URDF: bodies, inertias, joints and their limits.

Pinocchio reads a new document with these parts only: it opens no meshes, and the file can include no other.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from lipcore.robots.library import pinocchio
from lipcore.robots.urdf_text import MAX_DEPTH, UrdfError, add_origin, join_numbers, scan

PROBE = """<mujoco model="probe"><worldbody><body name="a"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
<joint name="b" type="slide" range="0 1"/></body></worldbody></mujoco>"""
"""A slide with a range of one metre."""
PARTS = frozenset(("mujoco", "compiler", "default", "worldbody", "body", "frame", "joint", "inertial", "geom"))
"""Elements that are read. Geoms matter for the inertia of bodies that state none."""
SOLIDS = ("box", "sphere", "capsule", "cylinder", "ellipsoid")
NUMBERS = frozenset(("pos", "quat", "euler", "axisangle", "xyaxes", "zaxis", "axis", "range", "ref", "mass", "density"))
NUMBERS |= {"diaginertia", "fullinertia", "size", "fromto", "actuatorfrcrange"}
"""Attributes that are numbers. Pinocchio would ignore other text."""
FILES = ("file", "mesh", "hfield", "material", "meshdir", "texturedir", "assetdir")
"""Attributes that refer to files or to what is read from them."""


def is_mjcf(text: str) -> bool:
    """Return whether a text is in this format, not in URDF."""
    return text.find("<mujoco") >= 0 and text.find("<robot") < 0


def convert_mjcf(text: str, folder: Path) -> str:
    """Return the URDF of a robot in MJCF. folder: for a file that Pinocchio reads. Raise UrdfError.

    A robot with a free or ball joint, two joints in one body, or a moving body without mass is rejected.
    """
    scanner = _Scanner()
    scan(text, "MJCF", scanner)
    model = _build(ElementTree.tostring(scanner.root, encoding="unicode"), folder)
    angles = {each.get("angle", "degree") for each in scanner.root.iter("compiler")} or {"degree"}
    # some versions of Pinocchio also convert the ranges of slides from degrees
    slide = 1.0 if angles == {"radian"} else 1 / float(_build(PROBE, folder).upperPositionLimit[0])
    return _urdf_of(model, scanner.root.get("model", "robot"), slide)


def _build(text: str, folder: Path) -> Any:
    path = folder / "robot.xml"
    path.write_text(text, encoding="utf-8")
    try:
        return pinocchio().buildModelFromMJCF(str(path))
    except (ValueError, RuntimeError) as error:
        raise UrdfError(f"Pinocchio cannot read the MJCF: {str(error).strip()[:300]}") from None


class _Scanner:
    """Handlers of expat that copy the elements of PARTS without references to files."""

    def __init__(self) -> None:
        self.root = ElementTree.Element("mujoco")
        self._path: list[ElementTree.Element | None] = []

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        if len(self._path) == MAX_DEPTH:
            raise UrdfError(f"the MJCF nests elements more than {MAX_DEPTH} deep")
        if tag in ("include", "attach", "replicate", "freejoint"):
            raise UrdfError(f"the MJCF has <{tag}>, expected one file with a fixed base")
        kept = {name: value for name, value in attributes.items() if name not in FILES}
        for name in NUMBERS & kept.keys():
            if not all(map(_is_finite, kept[name].split())):
                raise UrdfError(f"{name} of <{tag[:40]}> is {kept[name][:100]!r}, expected numbers")
        if not self._path:
            if tag != "mujoco":
                raise UrdfError(f"the root element is <{tag[:40]}>, expected <mujoco>")
            self.root.attrib.update(kept)
            self._path.append(self.root)
            return
        above = self._path[-1]
        solid = tag != "geom" or (attributes.get("type") in SOLIDS and "mesh" not in attributes)
        inside = above is not None and tag in PARTS and solid
        self._path.append(ElementTree.SubElement(above, tag, kept) if inside and above is not None else None)

    def end(self, tag: str) -> None:
        self._path.pop()


def _urdf_of(model: Any, name: str, slide: float) -> str:
    """Return the URDF of Pinocchio's model. slide: factor on the ranges of its slides."""
    pin = pinocchio()
    root = ElementTree.Element("robot", name=name)
    ElementTree.SubElement(root, "link", name="base")
    data, neutral = model.createData(), pin.neutral(model)
    links = ["base", *(f"{joint}_link" for joint in tuple(model.names)[1:])]
    for index, joint in enumerate(tuple(model.names)[1:], start=1):
        kind, inertia = model.joints[index], model.inertias[index]
        if kind.nv != 1:
            raise UrdfError(f"joint {joint!r} has {kind.nv} degrees of freedom, expected one hinge or slide per body")
        if inertia.mass <= 0:
            raise UrdfError(f"the body that joint {joint!r} moves has no mass, expected an <inertial>")
        body = ElementTree.SubElement(ElementTree.SubElement(root, "link", name=links[index]), "inertial")
        add_origin(body, inertia.lever, np.eye(3))
        ElementTree.SubElement(body, "mass", value=f"{inertia.mass:.12g}")
        parts = {f"i{'xyz'[a]}{'xyz'[b]}": f"{inertia.inertia[a, b]:.12g}" for a in range(3) for b in range(a, 3)}
        ElementTree.SubElement(body, "inertia", parts)
        motion = pin.computeJointJacobian(model, data, neutral, index)[:, kind.idx_v]
        turns = bool(np.abs(motion[3:]).max() > 0.5)
        lower, upper = (float(limit[kind.idx_q]) for limit in (model.lowerPositionLimit, model.upperPositionLimit))
        bounded = kind.nq == 1 and np.isfinite([lower, upper]).all() and upper > lower
        what = ("revolute" if bounded else "continuous") if turns else "prismatic"
        element = ElementTree.SubElement(root, "joint", name=joint, type=what)
        place = model.jointPlacements[index]
        add_origin(element, place.translation, place.rotation)
        ElementTree.SubElement(element, "parent", link=links[model.parents[index]])
        ElementTree.SubElement(element, "child", link=links[index])
        ElementTree.SubElement(element, "axis", xyz=join_numbers(motion[3:] if turns else motion[:3]))
        factor = 1.0 if turns else slide
        limits = {"lower": factor * lower, "upper": factor * upper} if bounded else {}
        limits |= {"effort": float(model.effortLimit[kind.idx_v]), "velocity": float(model.velocityLimit[kind.idx_v])}
        given = {key: f"{limit:.12g}" if np.isfinite(limit) else "0" for key, limit in limits.items()}
        ElementTree.SubElement(element, "limit", given)
    return ElementTree.tostring(root, encoding="unicode")


def _is_finite(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False

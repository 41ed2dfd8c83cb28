"""Robots in SDF, converted to URDF: links, inertias, joints and their limits (http://sdformat.org/spec).

A URDF's link has the frame of the joint that moves it, and its base that of the world; an SDF's link has a frame of its
own. The model's frame is that of the world: its pose there is ignored. Meshes, sensors and plugins are left out, and no
other file is included.
"""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from lipcore.data.samples import Array
from lipcore.robots.library import pinocchio
from lipcore.robots.urdf_text import MAX_DEPTH, UrdfError, add_origin, join_numbers, scan

KINDS = {"revolute": "revolute", "prismatic": "prismatic", "continuous": "continuous", "fixed": "fixed"}
UNBOUNDED = 1e16
"""SDF's value of a limit that does not bind."""


def is_sdf(text: str) -> bool:
    """Return whether a text is in this format."""
    return text.find("<sdf") >= 0 and text.find("<robot") < 0


class _Depth:
    """Handlers of expat that limit the depth of a document."""

    def __init__(self) -> None:
        self.depth = 0

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise UrdfError(f"the SDF nests elements more than {MAX_DEPTH} deep")
        if tag == "include":
            raise UrdfError("the SDF has <include>, expected one file with the whole robot")

    def end(self, tag: str) -> None:
        self.depth -= 1


def convert_sdf(text: str) -> str:
    """Return the URDF of the one model in an SDF; raise UrdfError."""
    scan(text, "SDF", _Depth())
    try:
        root = ElementTree.fromstring(text)  # noqa: S314 - document types are refused above
    except ElementTree.ParseError as error:
        raise UrdfError(f"the SDF is not well-formed XML: {error}") from None
    models = list(root.iter("model"))
    if len(models) != 1:
        raise UrdfError(f"the SDF has {len(models)} models, expected one, without nested models")
    model = models[0]
    frames = _Frames(model)
    joints = model.findall("joint")
    moved = {_text(each, "child"): each for each in joints}
    out = Element("robot", name=model.get("name", "robot"))
    if any(_text(each, "parent") == "world" for each in joints):
        SubElement(out, "link", name="world")
    for link in model.findall("link"):
        name = link.get("name", "")
        above = moved.get(name)
        frame = np.eye(4) if above is None else frames.of(above.get("name", ""))
        inertial = link.find("inertial")
        made = SubElement(out, "link", name=name)
        if inertial is not None:
            body = SubElement(made, "inertial")
            _add_pose(body, np.linalg.solve(frame, frames.of(name) @ _pose(inertial)))
            SubElement(body, "mass", value=_text(inertial, "mass", "1"))
            inertia = inertial.find("inertia")
            diagonal = {"ixx": "1", "iyy": "1", "izz": "1"} if inertia is None else {}
            parts = {key: diagonal.get(key, "0") for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")}
            parts |= {} if inertia is None else {key: _text(inertia, key, each) for key, each in parts.items()}
            SubElement(body, "inertia", parts)
    for joint in joints:
        _add_joint(out, joint, frames, moved)
    return ElementTree.tostring(out, encoding="unicode")


def _add_joint(out: Element, joint: Element, frames: _Frames, moved: dict[str, Element]) -> None:
    name, kind, parent = joint.get("name", ""), joint.get("type", ""), _text(joint, "parent")
    if kind not in KINDS:
        raise UrdfError(f"joint {name!r} is of type {kind!r}, expected one of {', '.join(KINDS)}")
    above = moved.get(parent)
    start = np.eye(4) if above is None else frames.of(above.get("name", ""))
    axis, limits = joint.find("axis"), dict[str, str]()
    direction = np.array([0.0, 0.0, 1.0]) if axis is None else _numbers(axis.find("xyz"), "0 0 1", 3)
    if axis is not None:
        xyz = axis.find("xyz")
        base = "" if xyz is None else xyz.get("expressed_in", "")
        if _text(axis, "use_parent_model_frame", "0") in ("1", "true"):
            base = "__model__"
        if base:
            direction = frames.of(name)[:3, :3].T @ frames.of(base)[:3, :3] @ direction
        bounds = axis.find("limit")
        given = {} if bounds is None else {each.tag: float(_numbers(each, "0", 1)[0]) for each in bounds}
        limits = {
            key: f"{each:.12g}" for key, each in given.items() if key in ("lower", "upper") if abs(each) < UNBOUNDED
        }
        kind = "continuous" if kind == "revolute" and len(limits) < 2 else kind
        limits = {} if kind == "continuous" else limits
        force = {key: given.get(key, -1.0) for key in ("effort", "velocity")}
        limits |= {key: f"{each:.12g}" if 0 <= each < UNBOUNDED else "0" for key, each in force.items()}
    element = SubElement(out, "joint", name=name, type=KINDS[kind])
    _add_pose(element, np.linalg.solve(start, frames.of(name)))
    SubElement(element, "parent", link=parent)
    SubElement(element, "child", link=_text(joint, "child"))
    if kind != "fixed":
        SubElement(element, "axis", xyz=join_numbers(direction))
        SubElement(element, "limit", limits or {"effort": "0", "velocity": "0"})


class _Frames:
    """The frames of a model: poses (4, 4) of its links, joints and frames in the model."""

    def __init__(self, model: Element) -> None:
        self._elements = {
            each.get("name", ""): each for tag in ("link", "joint", "frame") for each in model.findall(tag)
        }
        self._known: dict[str, Array | None] = {"__model__": np.eye(4), "world": np.eye(4)}

    def of(self, name: str) -> Array:
        """Return the pose of a frame in the model; raise UrdfError."""
        if name not in self._known:
            if name not in self._elements:
                raise UrdfError(f"the SDF refers to {name[:100]!r}, which is no link, joint or frame of the model")
            self._known[name] = None  # until it is known: a loop finds it
            element = self._elements[name]
            pose = element.find("pose")
            default = {"joint": _text(element, "child"), "frame": element.get("attached_to", "__model__")}
            base = "" if pose is None else pose.get("relative_to") or pose.get("frame") or ""
            self._known[name] = self.of(base or default.get(element.tag) or "__model__") @ _pose(element)
        found = self._known[name]
        if found is None:
            raise UrdfError(f"the pose of {name[:100]!r} depends on itself")
        return found


def _pose(element: Element) -> Array:
    """Return the pose of an element, (4, 4)."""
    pose = element.find("pose")
    x, y, z, roll, pitch, yaw = _numbers(pose, "0 0 0 0 0 0", 6)
    if pose is not None and pose.get("degrees", "false") in ("1", "true"):
        roll, pitch, yaw = np.radians([roll, pitch, yaw])
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = pinocchio().rpy.rpyToMatrix(roll, pitch, yaw), (x, y, z)
    return out


def _add_pose(element: Element, pose: Any) -> None:
    add_origin(element, pose[:3, 3], pose[:3, :3])


def _text(element: Element, tag: str, default: str = "") -> str:
    return (element.findtext(tag) or default).strip()


def _numbers(element: Element | None, default: str, count: int) -> Array:
    text = (default if element is None else element.text or default).split()
    try:
        values = np.array([float(each) for each in text])
    except ValueError:
        values = np.full(1, np.nan)
    if len(values) != count or not np.isfinite(values).all():
        tag = "" if element is None else element.tag[:40]
        raise UrdfError(f"<{tag}> is {' '.join(text)[:100]!r}, expected {count} numbers")
    return values

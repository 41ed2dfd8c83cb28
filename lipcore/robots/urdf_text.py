"""The text of a URDF, checked before Pinocchio parses it.

A URDF may be hostile: it is read as text, never as a path. Document types, deep nesting, loops and endless chains are
rejected, because they could exhaust a parser. Pinocchio reads only a new document of the checked links, with their
inertias, and joints. Meshes, materials and transmissions are omitted, so nothing opens them. Pinocchio's parser, which
writes complaints straight to stderr, has nothing to complain about.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from lipcore.robots.library import pinocchio
from lipcore.vocabulary import JointType

MOVABLE: dict[str, JointType] = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
MAX_DEPTH = 32
MAX_LINKS = 500
"""Max links of a URDF: parsers and Pinocchio recurse from link to link, and a long chain would exhaust the stack."""
MAX_VALUES = {"mass": 1e6, "inertia": 1e9, "limit": 1e18}
"""Max magnitudes of numbers by element, kg, kg·m² and of any unit, and 1e4 of every other, m and rad: results
computed from them stay finite."""
NUMBERS = {
    "origin": {"xyz": 3, "rpy": 3},
    "mass": {"value": 1},
    "inertia": dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), 1),
    "axis": {"xyz": 3},
    "limit": dict.fromkeys(("lower", "upper", "effort", "velocity"), 1),
    "mimic": {"multiplier": 1, "offset": 1},
}
"""Attributes of the elements read that are numbers, with their count."""
NAMES = {"parent": ("link",), "child": ("link",), "mimic": ("joint",)}
TREE = {
    "robot": ("link", "joint"),
    "link": ("inertial",),
    "inertial": ("origin", "mass", "inertia"),
    "joint": ("origin", "parent", "child", "axis", "limit", "mimic"),
    **dict.fromkeys((*NUMBERS, *NAMES), ()),
}
"""Elements that are read, by their parent element."""


class UrdfError(ValueError):
    """The text is no usable URDF; the message says why."""


@dataclass(frozen=True)
class UrdfJoint:
    """A joint of the URDF. kind: its `type` there; mimics: the joint that it follows, at multiplier · q + offset."""

    name: str
    kind: str
    parent: str
    child: str
    mimics: str | None = None
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class UrdfText:
    """A checked URDF. joints: all joints; plain: links with inertias and joints, rewritten for Pinocchio."""

    robot: str
    joints: tuple[UrdfJoint, ...]
    plain: str


def read_urdf(urdf: str) -> UrdfText:
    """Return the checked content of a URDF, in one pass that rejects what must not reach a recursive parser.

    Raise UrdfError.
    """
    scanner = _Scanner()
    scan(urdf, "URDF", scanner)
    links, entries = scanner.root.findall("link"), scanner.root.findall("joint")
    if len(links) > MAX_LINKS:
        raise UrdfError(f"the URDF has {len(links)} links, expected at most {MAX_LINKS}")
    joints = tuple(_joint(entry) for entry in entries)
    _check_tree([link.get("name", "") for link in links], joints)
    for joint in joints:
        if joint.kind not in MOVABLE and joint.kind != "fixed":
            raise UrdfError(
                f"joint {joint.name!r} is of type {joint.kind!r}: expected a fixed base and joints of type "
                f"{', '.join(MOVABLE)} or fixed"
            )
    return UrdfText(scanner.root.get("name", ""), joints, ElementTree.tostring(scanner.root, encoding="unicode"))


class Scanner(Protocol):
    """Handlers of the elements of a document."""

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        """Handle the start of an element."""

    def end(self, tag: str) -> None:
        """Handle its end."""


def scan(text: str, form: str, scanner: Scanner) -> None:
    """Pass the elements of a document to a scanner; raise UrdfError for wrong XML or a declaration. form: its name."""

    def refuse_declaration(*_: Any) -> None:
        raise UrdfError(
            f"the {form} declares a document type or an entity (<!DOCTYPE>, <!ENTITY>), which is not accepted"
        )

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = scanner.start, scanner.end
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse_declaration
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        raise UrdfError(f"the {form} is not well-formed XML: {error}") from None
    except UnicodeEncodeError as error:
        raise UrdfError(f"the {form} is not text: {error}") from None


def _joint(entry: ElementTree.Element) -> UrdfJoint:
    ends = {tag: entry.find(tag) for tag in ("parent", "child", "mimic")}
    parent, child = ("" if (end := ends[tag]) is None else end.get("link", "") for tag in ("parent", "child"))
    mimic, own = ends["mimic"], (entry.get("name", ""), entry.get("type", ""), parent, child)
    if mimic is None:
        return UrdfJoint(*own)
    rates = float(mimic.get("multiplier", "1")), float(mimic.get("offset", "0"))
    return UrdfJoint(*own, mimic.get("joint", ""), *rates)


def _check_tree(links: Sequence[str], joints: Sequence[UrdfJoint]) -> None:
    """Raise UrdfError unless joints connect links to one tree, each with a unique name."""
    for kind, names in (("links", links), ("joints", [joint.name for joint in joints])):
        if twice := [name for name, count in Counter(names).items() if count > 1]:
            raise UrdfError(f"two {kind} are called {twice[0]!r}, expected distinct names")
    below: dict[str, list[str]] = {name: [] for name in links}
    moved: dict[str, str] = {}
    for joint in joints:
        for role, name in (("parent", joint.parent), ("child", joint.child)):
            if name not in below:
                raise UrdfError(f"joint {joint.name!r} has the {role} {name!r}, expected a link of the URDF")
        if joint.child in moved:
            raise UrdfError(
                f"link {joint.child!r} is the child of two joints, {moved[joint.child]!r} and {joint.name!r}: a closed "
                "loop cannot be used, expected a tree"
            )
        moved[joint.child] = joint.name
        below[joint.parent].append(joint.child)
    roots = [name for name in links if name not in moved]
    if len(roots) > 1:
        raise UrdfError(f"no joint leads to the links {roots[0]!r} and {roots[1]!r}, expected one root")
    reached = list(roots)
    for name in reached:
        reached += below[name]
    if missing := sorted(set(links) - set(reached)):
        raise UrdfError(f"the joints that lead to link {missing[0]!r} form a closed loop, expected a tree")


class _Scanner:
    """Handlers of expat that copy links with their inertias, and joints, and check their names and numbers."""

    def __init__(self) -> None:
        self.root = ElementTree.Element("robot")
        self._path: list[tuple[str, ElementTree.Element | None]] = []

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        if len(self._path) == MAX_DEPTH:
            raise UrdfError(f"the URDF nests elements more than {MAX_DEPTH} deep")
        if not self._path:
            if tag != "robot":
                raise UrdfError(f"the root element is <{tag[:40]}>, expected <robot>")
            self.root.set("name", _name(attributes.get("name", "")[:200], "the robot"))
            self._path.append((tag, self.root))
            return
        inside, above = self._path[-1]
        copied = None
        if above is not None and tag in TREE[inside]:
            copied = ElementTree.SubElement(above, tag, self._checked(tag, attributes))
        self._path.append((tag, copied))

    def end(self, _tag: str) -> None:
        self._path.pop()

    def _checked(self, tag: str, attributes: dict[str, str]) -> dict[str, str]:
        """Return those attributes of an element that are used, with checked numbers in plain notation."""
        if tag in ("link", "joint"):
            kind = {"type": attributes.get("type", "")[:40]} if tag == "joint" else {}
            return {"name": _name(attributes.get("name", ""), f"a {tag}")} | kind
        top = self.root[-1]
        where = f"{top.tag} {top.get('name')!r}"
        kept = {name: _name(attributes.get(name, ""), f"the {tag} of {where}") for name in NAMES.get(tag, ())}
        for name, count in NUMBERS.get(tag, {}).items():
            if (text := attributes.get(name)) is not None:
                numbers = _numbers(text, count, MAX_VALUES.get(tag, 1e4), f"<{tag} {name}> of {where}")
                kept[name] = " ".join(repr(each) for each in numbers)
                moves = tag == "axis" and top.get("type") in MOVABLE  # the axis of a fixed joint is often 0 0 0
                if moves and not 1e-3 <= (length := float(np.hypot.reduce(numbers))) <= 1e3:
                    raise UrdfError(
                        f"<axis xyz> of {where} is {text[:80]!r}, of length {length:g}, expected a direction"
                    )
        return kept


def _name(text: str, what: str) -> str:
    if not text.isprintable():
        raise UrdfError(f"{what} is called {text[:80]!r}, expected a printable name")
    return text


def _numbers(text: str, count: int, largest: float, what: str) -> list[float]:
    """Return the numbers of an attribute; raise UrdfError for another count or a number above `largest`."""
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or "_" in text or not all(abs(number) <= largest for number in numbers):
        several = f"{count} numbers" if count > 1 else "a number"
        raise UrdfError(f"{what} is {text[:80]!r}, expected {several} of at most {largest:g}")
    return numbers


def add_origin(element: ElementTree.Element, place: Any, rotation: Any) -> None:
    """Add the `<origin>` of a frame: its place (3,), m, and its rotation (3, 3)."""
    angles = pinocchio().rpy.matrixToRpy(np.array(rotation))
    ElementTree.SubElement(element, "origin", xyz=join_numbers(place), rpy=join_numbers(angles))


def join_numbers(values: Any) -> str:
    """Return the text of an attribute with several numbers."""
    return " ".join(f"{float(value):.12g}" for value in values)

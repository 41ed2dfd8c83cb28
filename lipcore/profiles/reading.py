"""Joints and limits that a URDF holds."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np

from lipcore.data.motion import Array
from lipcore.profiles.profile import Profile
from lipcore.robots.urdf import MOVABLE, UrdfError, describe
from lipcore.vocabulary import JointType

NOTE = "A URDF does not say what the effort field means: say it with `effort`."


@dataclass(frozen=True)
class Limits:
    """Types and limits of joints in the order they were asked for, (n,) each, SI units.

    lower, upper: position; speed; torque. Infinite where a joint turns freely, NaN where unknown.
    """

    types: tuple[JointType, ...]
    lower: Array
    upper: Array
    speed: Array
    torque: Array


def from_urdf(text: str, name: str) -> Profile:
    """The profile of a URDF's joints that move, from base to tip, branch after branch, mimicking ones left out.

    Data need not hold every joint of it: grippers may be missing. Raise UrdfError where the text cannot be used.
    """
    moving = set(describe(text).joint_names)
    joints = tuple(name for name in _from_base(text) if name in moving)
    limits = read_limits(text, joints)
    n_joints = len(joints)
    return Profile(
        name=name,
        title=name,
        joint_names=joints,
        joint_types=limits.types,
        lower=limits.lower,
        upper=limits.upper,
        speed=limits.speed,
        acceleration=np.full(n_joints, np.nan),
        torque=limits.torque,
        effort="unknown",
        effort_note=NOTE,
        torque_constants=None,
        joint_aliases=((),) * n_joints,
        urdf=text,
        source="its URDF",
        complete=False,
    )


def _from_base(text: str) -> list[str]:
    """Names of all joints, those of a branch together and from base to tip, whatever the order of the text."""
    below: defaultdict[str, list[tuple[str, str]]] = defaultdict(list)
    for joint in _root(text).findall("joint"):
        below[_link(joint, "parent")].append((joint.get("name", ""), _link(joint, "child")))
    moved = {child for each in below.values() for _, child in each}
    waiting = [each for link in below if link not in moved for each in below[link]][::-1]
    names = []
    while waiting:
        name, child = waiting.pop()
        names.append(name)
        waiting.extend(reversed(below.get(child, [])))
    return names


def _link(joint: ElementTree.Element, which: str) -> str:
    element = joint.find(which)
    return "" if element is None else element.get("link", "")


def _root(text: str) -> ElementTree.Element:
    try:
        # whoever calls has refused document types, entities and deep nesting, or trusts the file
        return ElementTree.fromstring(text)  # noqa: S314
    except ElementTree.ParseError as error:
        raise UrdfError(f"the URDF is not well-formed XML: {error}") from None


def read_limits(text: str, joints: Sequence[str]) -> Limits:
    """What a URDF that was checked says of these joints; raise UrdfError for one that it has not, or for a bad number.

    A limit of speed or effort that is not above 0 is none, nor is a range that holds no interval.
    """
    elements = {joint.get("name", ""): joint for joint in _root(text).findall("joint")}
    types: list[JointType] = []
    rows = []
    for name in joints:
        if name not in elements or elements[name].get("type") not in MOVABLE:
            raise UrdfError(f"the URDF has no joint {name!r} that moves")
        kind = elements[name].get("type", "")
        types.append(MOVABLE[kind])
        limit = elements[name].find("limit")
        given: Mapping[str, str] = {} if limit is None else limit.attrib
        lower, upper, speed, torque = (_number(name, given, key) for key in ("lower", "upper", "velocity", "effort"))
        if kind == "continuous":
            lower, upper = -np.inf, np.inf
        elif not upper > lower:
            lower = upper = np.nan
        rows.append((lower, upper, speed if speed > 0 else np.nan, torque if torque > 0 else np.nan))
    columns = np.array(rows, dtype=np.float64).reshape(len(types), 4).T
    return Limits(tuple(types), *columns)


def _number(joint: str, given: Mapping[str, str], key: str) -> float:
    text = given.get(key, "0")
    try:
        return float(text)
    except ValueError:
        raise UrdfError(f"the limit {key!r} of joint {joint!r} is {text[:40]!r}, expected a number") from None

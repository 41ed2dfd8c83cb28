"""The profile of a robot: joints, limits, and the meaning of its effort field; also from a URDF."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from xml.etree import ElementTree

import numpy as np
from msgspec import Struct

from lipcore.data.motion import Array
from lipcore.profiles.names import Assignment, find_assignments, find_makes, is_number
from lipcore.robots.urdf import describe
from lipcore.robots.urdf_text import MOVABLE, UrdfError
from lipcore.vocabulary import EffortMeaning, JointType


class ProfileEntry(Struct, frozen=True, forbid_unknown_fields=True):
    """The entry of a robot in `arms.toml`, which documents the fields, without its URDF."""

    title: str
    effort: EffortMeaning
    effort_note: str
    source: str
    remark: str = ""
    joints: tuple[str, ...] = ()
    aliases: tuple[tuple[str, ...], ...] = ()
    degrees: bool = False
    ranges: tuple[tuple[float, float], ...] | None = None
    speed: tuple[float, ...] | None = None
    torque: tuple[float, ...] | None = None
    acceleration: tuple[float, ...] | None = None
    placeholders: bool = False


def array_or_nan(values: Sequence[float] | None, n_joints: int) -> Array:
    """Return values as an array (n,), NaN if there are none."""
    return np.full(n_joints, np.nan) if values is None else np.array(values, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Profile:
    """An arm with n joints, from base to tip. Limits are NaN if unknown."""

    name: str
    title: str
    joint_names: tuple[str, ...]
    joint_types: tuple[JointType, ...]
    lower: Array
    """Min positions, (n,) rad (m), infinite for continuous joints."""
    upper: Array
    """Max positions, (n,) rad (m), infinite for continuous joints."""
    speed: Array
    """Max speeds, (n,) rad/s (m/s)."""
    acceleration: Array
    """Max accelerations, (n,) rad/s² (m/s²)."""
    torque: Array
    """Max torques, (n,) N·m (N)."""
    effort: EffortMeaning
    """Meaning of the effort field."""
    effort_note: str
    torque_constants: Array | None
    """Torque per motor current, (n,) N·m/A."""
    joint_aliases: tuple[tuple[str, ...], ...]
    """Other names of each joint, (n)."""
    urdf: str | None = field(repr=False)
    """Text of the URDF, None if there is none."""
    source: str
    """Source of the numbers."""
    complete: bool = True
    """Whether data of this robot contain every joint. Data for an uploaded URDF may lack its fingers."""

    def __post_init__(self) -> None:
        n = len(self.joint_names)
        for what in ("lower", "upper", "speed", "acceleration", "torque", "torque_constants"):
            values = getattr(self, what)
            if values is not None and values.shape != (n,):
                raise ValueError(f"{what} of {self.name!r} has shape {values.shape}, expected {(n,)}")
        for what in ("joint_types", "joint_aliases"):
            if len(getattr(self, what)) != n:
                raise ValueError(f"{what} of {self.name!r} has {len(getattr(self, what))} entries, expected {n}")

    @property
    def n_joints(self) -> int:
        """Return the number of joints n."""
        return len(self.joint_names)

    @cached_property
    def makes(self) -> frozenset[str]:
        """Return the makes that names of its joints may contain."""
        text = " ".join((self.name, self.title, *self.joint_names, *sum(self.joint_aliases, ())))
        return find_makes(text)

    def list_assignments(self, names: Sequence[str], numbers: bool = True) -> list[Assignment]:
        """Return each assignment of the names to joints of this robot; two arms side by side return two.

        numbers: whether a number alone may name a joint.
        """
        aliases = [(name, *others) for name, others in zip(self.joint_names, self.joint_aliases, strict=True)]
        return list(find_assignments(tuple(names), aliases, self.makes, numbers))

    def match(self, names: Sequence[str]) -> tuple[int | None, ...]:
        """Return the joint of each name, None if there is none or more than one: (N,)."""
        readings = self.list_assignments(names)
        largest = max(map(len, readings), default=0)
        best = [each for each in readings if len(each) == largest]
        if len(best) != 1 or 2 * largest <= min(self.n_joints, len(names)):
            return (None,) * len(names)
        joint_at = {place: joint for joint, place in best[0].items()}
        return tuple(joint_at.get(place) for place in range(len(names)))

    def order_of(self, names: Sequence[str]) -> list[int] | None:
        """Return the indices of this robot's joints among the names, from base to tip; other names are ignored.

        None if a joint is missing or has several candidates. An incomplete profile returns the joints that are present.
        """
        matched = self.match(names)
        places = {joint: place for place, joint in enumerate(matched) if joint is not None}
        if not places or (self.complete and len(places) < self.n_joints):
            return None
        return [places[joint] for joint in sorted(places)]

    def official_names(self, names: Sequence[str]) -> tuple[str, ...] | None:
        """Return this robot's own name of each joint; None unless every name is a joint of it.

        If only some of its joints are named, numbers are not enough: joints 1 and 2 exist on any robot.
        """
        matched = [joint for joint in self.match(names) if joint is not None]
        if len(matched) < len(names) or (len(names) < self.n_joints and all(map(is_number, names))):
            return None
        return tuple(self.joint_names[joint] for joint in matched)

    def explain_missing_urdf(self) -> str:
        """Return a sentence with the reason why rigid bodies cannot be built by this name."""
        return (
            f"the profile of {self.title} has no URDF: to use its rigid bodies, upload a URDF and give its id as robot"
        )


@dataclass(frozen=True)
class Limits:
    """Types and limits of joints in the requested order, (n,) each, SI units. Limits are NaN if unknown."""

    types: tuple[JointType, ...]
    lower: Array
    """Min positions, infinite for continuous joints."""
    upper: Array
    """Max positions, infinite for continuous joints."""
    speed: Array
    torque: Array


def from_urdf(text: str, name: str) -> Profile:
    """Return the profile of a URDF's moving joints, from base to tip, branch after branch, without mimicking ones.

    Data may lack joints of it, such as grippers. Raise UrdfError if the text cannot be used.
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
        effort_note="A URDF does not specify the meaning of the effort field: give it with `effort`.",
        torque_constants=None,
        joint_aliases=((),) * n_joints,
        urdf=text,
        source="its URDF",
        complete=False,
    )


def _from_base(text: str) -> list[str]:
    """Return the names of all joints, branch by branch and from base to tip, for any order of the text."""
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
        # callers reject document types, entities and deep nesting before, or trust the file
        return ElementTree.fromstring(text)  # noqa: S314
    except ElementTree.ParseError as error:
        raise UrdfError(f"the URDF is not well-formed XML: {error}") from None


def read_limits(text: str, joints: Sequence[str]) -> Limits:
    """Return the limits of these joints in a checked URDF; raise UrdfError for a missing joint or a bad number.

    A limit of speed or effort that is not above 0, or an empty range, counts as unknown.
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

"""Rigid bodies of a URDF, in the order of the data's joints."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from lipcore.data.motion import check_joint_types
from lipcore.data.samples import Array
from lipcore.robots.library import ROBOTS, UnknownRobotError, pinocchio, profile_urdf
from lipcore.robots.urdf_text import MOVABLE, UrdfError, UrdfJoint, read_urdf
from lipcore.robots.urdf_units import check_bodies
from lipcore.vocabulary import JointType

Matching = Literal["name", "order", "list"]
"""How the data's joints were matched with the URDF's: by name, by order (profiles only), by an explicit list."""

PARAMETERS = 10
"""Inertial parameters of a body: mass, first moment (3), inertia (xx, xy, yy, xz, yz, zz) about its joint's frame."""


class JointMismatchError(ValueError):
    """The joints of the URDF are not those of the data; the message names both."""


@dataclass(frozen=True)
class Description:
    """Name and joints of a URDF. joints: those that move, without mimicking ones, in the order of the text."""

    name: str
    joints: tuple[UrdfJoint, ...]

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Return the names of the joints that move."""
        return tuple(joint.name for joint in self.joints)


@dataclass(frozen=True)
class Follower:
    """A slider that follows another one on the same link, such as the second finger of a gripper.

    With the leader's position q, it is displaced by `rate` · q along the leader's axis.
    """

    joint: str
    leader: str
    rate: float
    body: Array = field(repr=False, compare=False)
    """Inertial parameters of what it moves, in the frame of the leader at q = 0, (10,)."""


@dataclass(frozen=True)
class RigidBody:
    """Serial arms on one fixed base, with n moving bodies, in the order of the data's joints."""

    name: str
    urdf: str
    """Text of the URDF."""
    joint_names: tuple[str, ...]
    joint_types: tuple[JointType, ...]
    urdf_joints: tuple[str, ...]
    """The URDF's name of each joint of the data."""
    matched: Matching
    """How the joints were matched."""
    model: Any = field(repr=False, compare=False)
    """Pinocchio's model, with every other joint locked at neutral: its arms one after another."""
    fixed_joints: tuple[str, ...] = ()
    """The URDF's joints that move, but are locked because the data lack them."""
    followers: tuple[Follower, ...] = ()
    """Joints that follow one of the data."""

    @classmethod
    def from_urdf(
        cls,
        urdf: str,
        joint_names: Sequence[str],
        joint_types: Sequence[str],
        joints: Sequence[str] | None = None,
        name: str | None = None,
    ) -> RigidBody:
        """Build from a URDF's text for data with these joints; `joints` names the URDF's joints in the data's order.

        Without `joints` the names have to be equal. Raise UrdfError, JointMismatchError, or ValueError for a type.
        """
        urdf_joints = tuple(joint_names if joints is None else joints)
        return cls._build(urdf, joint_names, joint_types, urdf_joints, name, "name" if joints is None else "list")

    @classmethod
    def from_profile(cls, profile: str, joint_names: Sequence[str], joint_types: Sequence[str]) -> RigidBody:
        """Build a robot of ROBOTS; its joints are matched by name, or by order if the data have other names.

        Raise UnknownRobotError, MissingExtraError without example-robot-data, JointMismatchError.
        """
        if profile not in ROBOTS:
            raise UnknownRobotError(f"robot is {profile!r}, expected one of {', '.join(ROBOTS)}")
        free, given = ROBOTS[profile].free, tuple(joint_names)
        by_name = set(given) == set(free)
        # names that match in part, or at other places, mean another robot or another order
        if not by_name and (
            len(given) != len(free) or any(a != b and a in free for a, b in zip(given, free, strict=True))
        ):
            raise _mismatch(profile, free, given)
        urdf_joints = given if by_name else free
        urdf = profile_urdf(profile)
        return cls._build(urdf, given, joint_types, urdf_joints, profile, "name" if by_name else "order")

    @classmethod
    def _build(
        cls,
        urdf: str,
        joint_names: Sequence[str],
        joint_types: Sequence[str],
        urdf_joints: tuple[str, ...],
        name: str | None,
        matched: Matching,
    ) -> RigidBody:
        types, names = check_joint_types(joint_types), tuple(joint_names)
        text = read_urdf(urdf)
        everything = text.joints
        movable = {joint.name: joint for joint in everything if joint.kind in MOVABLE}
        robot, chosen = name or text.robot, set(urdf_joints)
        if len(urdf_joints) != len(names) or len(chosen) != len(names) or not movable.keys() >= chosen:
            listed = f"; `joints` lists {', '.join(urdf_joints)}" if matched == "list" else ""
            raise _mismatch(robot, tuple(movable), names, listed)
        if len(types) != len(names):
            raise ValueError(f"joint_types has {len(types)} entries, expected {len(names)}, one for each joint")
        for data_name, kind, joint in zip(names, types, (movable[joint] for joint in urdf_joints), strict=True):
            if MOVABLE[joint.kind] != kind:
                raise JointMismatchError(
                    f"joint {data_name!r} is {kind} in the data, but {joint.name!r} of robot {robot!r} is {joint.kind}"
                )
        following = _find_followers(everything, urdf_joints)
        full = _reduce(_parse(text.plain), (*urdf_joints, *(joint.name for joint in following)))
        followers = tuple(_follower(full, joint) for joint in following)
        model = _reduce(full, urdf_joints, {joint.name: joint.offset for joint in following}) if following else full
        _check_chain(tuple(model.names)[1:], [int(parent) - 1 for parent in tuple(model.parents)[1:]])
        moved = chosen | {joint.name for joint in following}
        fixed = tuple(joint for joint in movable if joint not in moved)
        return cls(robot, urdf, names, types, urdf_joints, matched, model, fixed, followers)

    def part(self, joints: Sequence[int]) -> RigidBody:
        """Return the bodies for some of the data's joints, in this order; the others are locked."""
        names, types, urdf_joints = (
            tuple(each[joint] for joint in joints) for each in (self.joint_names, self.joint_types, self.urdf_joints)
        )
        return self._build(self.urdf, names, types, urdf_joints, self.name, self.matched)

    @property
    def n_joints(self) -> int:
        """Return the number of joints n."""
        return len(self.joint_names)

    @property
    def sha256(self) -> str:
        """Return the hash of the URDF's text."""
        return hashlib.sha256(self.urdf.encode()).hexdigest()

    @property
    def order(self) -> tuple[int, ...]:
        """Return the index of each joint of the data in Pinocchio's model, from base to tip, arm after arm: (n,)."""
        place = {name: index for index, name in enumerate(tuple(self.model.names)[1:])}
        return tuple(place[name] for name in self.urdf_joints)

    @property
    def roots(self) -> tuple[int, ...]:
        """Return the index of each arm's first joint in Pinocchio's model."""
        return tuple(index for index, parent in enumerate(tuple(self.model.parents)[1:]) if parent == 0)

    def parameters(self) -> Array:
        """Return the inertial parameters of the body that each joint moves, locked links included: (n, 10).

        A follower's body is locked to the link before at first. Then `rate` times this body moves from there to the
        leader, so that both have the centre of mass of leader and follower at every position.
        """
        pin, model = pinocchio(), self.model
        chain = [inertia.toDynamicParameters() for inertia in tuple(model.inertias)[1:]]
        for each in self.followers:
            leader = model.getJointId(each.leader)
            chain[leader - 1] = chain[leader - 1] + each.rate * each.body
            if (before := model.parents[leader]) > 0:
                # parameters are linear in the mass, so those of a body of any sign are those of the body times the sign
                placed = model.jointPlacements[leader].act(pin.Inertia.FromDynamicParameters(each.body))
                chain[before - 1] = chain[before - 1] - each.rate * placed.toDynamicParameters()
        return np.array(chain)[list(self.order)]

    def rotors(self) -> Array:
        """Return the inertia of each joint beyond that of `parameters`, (n,) kg: the rest of its followers'."""
        out = np.zeros(self.n_joints)
        for each in self.followers:
            out[self.urdf_joints.index(each.leader)] += (each.rate**2 - each.rate) * each.body[0]
        return out

    def length(self) -> float:
        """Return the characteristic length, m: the mean distance from one joint of an arm to the next."""
        pairs = zip(tuple(self.model.jointPlacements)[1:], tuple(self.model.parents)[1:], strict=True)
        steps = [float(np.linalg.norm(place.translation)) for place, parent in pairs if parent]
        mean = float(np.mean(steps)) if steps else 0.0
        return mean if mean > 0.01 else 0.3  # shorter distances do not measure the links


def describe(urdf: str) -> Description:
    """Return the name and joints of a URDF that Pinocchio can read; raise UrdfError."""
    text = read_urdf(urdf)
    joints = tuple(joint for joint in text.joints if joint.kind in MOVABLE and joint.mimics is None)
    if not joints:
        raise UrdfError("the URDF has no joint that moves, expected revolute, continuous or prismatic joints")
    check_bodies(text.plain, _parse)
    return Description(text.robot, joints)


def _mismatch(robot: str, movable: Sequence[str], data: Sequence[str], listed: str = "") -> JointMismatchError:
    listed_joints, given = ", ".join(movable) or "none", ", ".join(data)
    return JointMismatchError(f"robot {robot!r} has the movable joints {listed_joints}; the data have {given}{listed}")


def _find_followers(joints: Sequence[UrdfJoint], free: Sequence[str]) -> list[UrdfJoint]:
    """Return the sliders that follow a slider of the data on the same link; raise UrdfError for other followers."""
    by_name, found = {joint.name: joint for joint in joints}, list[UrdfJoint]()
    for joint in joints:
        if joint.mimics is not None and joint.name in free:
            raise UrdfError(
                f"joint {joint.name!r} mimics {joint.mimics!r}: it does not move on its own. Leave it out of the data "
                "(`drop_joints` of an upload)"
            )
        if joint.mimics is None or joint.mimics not in free:
            continue
        leader = by_name[joint.mimics]
        if (joint.kind, leader.kind, joint.parent) != ("prismatic", "prismatic", leader.parent):
            raise _cannot_follow(joint)
        found.append(joint)
    return found


def _cannot_follow(joint: UrdfJoint) -> UrdfError:
    return UrdfError(
        f"joint {joint.name!r} mimics {joint.mimics!r} of the data: only a slider parallel to another one on the same "
        f"link can follow it. Without {joint.mimics!r} in the data (`drop_joints` of an upload), both are fixed at zero"
    )


def _follower(model: Any, joint: UrdfJoint) -> Follower:
    """Return a follower of a model in which it moves by itself; raise UrdfError if its axis is not parallel."""
    pin, (own, leader) = pinocchio(), (model.getJointId(name) for name in (joint.name, joint.mimics))
    places, axes = [], []
    for index in (own, leader):
        data = model.joints[index].createData()
        model.joints[index].calc(data, np.zeros(1))
        place = model.jointPlacements[index]
        places.append(place)
        axes.append(place.rotation @ np.asarray(data.S).reshape(6)[:3])
    along = float(axes[0] @ axes[1])
    if abs(along) < 1 - 1e-6:
        raise _cannot_follow(joint)
    slid = pin.SE3(places[0].rotation, places[0].translation + joint.offset * axes[0])
    body = (places[1].inverse() * slid).act(model.inertias[own]).toDynamicParameters()
    return Follower(joint.name, str(joint.mimics), joint.multiplier * along, np.asarray(body))


def _parse(plain: str) -> Any:
    pin = pinocchio()
    try:
        model = pin.buildModelFromXML(plain)
    except (ValueError, RuntimeError) as error:
        raise UrdfError(
            f"Pinocchio cannot read the URDF: {str(error).strip()[:300]} Usual reason: a "
            "revolute or prismatic joint has no <limit>"
        ) from None
    for name, inertia in zip(tuple(model.names), tuple(model.inertias), strict=True):
        values = inertia.toDynamicParameters()
        if not np.isfinite(values).all() or values[0] < 0:
            raise UrdfError(f"the body that joint {name!r} moves has mass {values[0]:g} kg or an inertia out of range")
    return model


def _reduce(full: Any, free: Sequence[str], places: Mapping[str, float] | None = None) -> Any:
    """Return the model with every joint locked but `free`, at neutral or at one of `places`."""
    pin = pinocchio()
    locked, at = [full.getJointId(name) for name in tuple(full.names)[1:] if name not in free], pin.neutral(full)
    for name, place in (places or {}).items():
        at[full.joints[full.getJointId(name)].idx_q] = place
    try:
        model = pin.buildReducedModel(full, locked, at) if locked else full
    except (ValueError, RuntimeError) as error:
        raise UrdfError(f"Pinocchio cannot lock the other joints of the URDF: {str(error).strip()[:300]}") from None
    names = tuple(model.names)
    if sorted(names[1:]) != sorted(free):
        raise UrdfError(
            f"locking left the joints {', '.join(names[1:])}, expected {', '.join(free)}. A name may be used twice"
        )
    return model


def _check_chain(names: Sequence[str], parents: Sequence[int]) -> None:
    """Raise UrdfError for a branch above the base. parents: index of the joint before each joint, -1: the base."""
    for index, parent in enumerate(parents):
        if parent not in (-1, index - 1):
            raise UrdfError(
                f"the joints branch: {names[index]!r} follows {names[parent]!r}, not {names[index - 1]!r}; expected "
                "serial arms that share only the fixed base. Leave out the joints of all branches but one (`joints` of "
                "an upload)"
            )

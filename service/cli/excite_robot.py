"""The robot that a motion is planned for: its limits, and its dynamics where a URDF tells them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lipcore import profiles
from lipcore.excitation import Limits
from lipcore.model.torque_model import TorqueModel
from lipcore.profiles import Profile
from lipcore.robots.library import ROBOTS, Robot, SimulationUnavailableError, load_robot
from lipcore.robots.urdf import RigidBody

MAX_URDF_BYTES = 16 * 1024 * 1024


@dataclass(frozen=True)
class Arm:
    """What is known of a robot. robot: its dynamics, None without a URDF; bodies: for estimators of rigid bodies."""

    name: str
    limits: Limits
    robot: Robot | None
    bodies: RigidBody | None


def find(given: str | None, model: TorqueModel | None) -> Arm:
    """The robot that is given, by name or as a .urdf file, or else the one that the model's joints tell.

    Its joints are called as the model's. Raise ValueError or OSError where there is no such robot or it does not fit.
    """
    if given is None:
        if model is None:
            raise ValueError("neither --robot nor --model is given, expected one of them: whose limits are to be kept?")
        return _of_model(model)
    if not given.endswith(".urdf"):
        return _named(given, model)
    path = Path(given)
    if (size := path.stat().st_size) > MAX_URDF_BYTES:
        raise ValueError(f"{given} has {size} bytes, expected at most {MAX_URDF_BYTES}")
    profile = profiles.from_urdf(path.read_text(encoding="utf-8"), path.stem)
    names = profile.joint_names
    if model is not None and set(model.joint_names) <= set(names):  # others, as of grippers, stand still
        names = model.joint_names
    return _of_urdf(profile, names, None if model is None else model.joint_names)


def _of_model(model: TorqueModel) -> Arm:
    if model.robot is not None:
        profile = profiles.from_urdf(model.robot.urdf, model.robot.name)
        return _of_urdf(profile, model.robot.urdf_joints, model.joint_names)
    names = profiles.recognise(model.joint_names)
    if len(names) != 1:
        fit = f"several robots have: {', '.join(names)}" if names else "no robot that is known has"
        raise ValueError(
            f"the model has the joints {', '.join(model.joint_names)}, which {fit}. Name the robot by --robot: "
            f"a .urdf file or one of {', '.join(profiles.names())}"
        )
    return _named(names[0], model)


def _named(name: str, model: TorqueModel | None) -> Arm:
    profile = profiles.profile(name)
    names = profile.joint_names if model is None else model.joint_names
    _check(profile, profile.joint_names, names)
    limits = replace(Limits.of_profile(profile), joint_names=names)
    robot, bodies = None, None
    if name in ROBOTS:
        try:
            robot = load_robot(name)
        except SimulationUnavailableError:  # limits are known all the same
            return Arm(name, limits, None, None)
        bodies = RigidBody.from_profile(name, robot.joint_names, robot.joint_types)
    return Arm(name, limits, robot, bodies)


def _of_urdf(profile: Profile, joints: Sequence[str], names: tuple[str, ...] | None) -> Arm:
    """joints: of the URDF, those that move; names: what the data call them."""
    if profile.urdf is None:
        raise ValueError(f"robot {profile.name!r} has no URDF")
    places = [profile.joint_names.index(joint) for joint in joints]
    types = [profile.joint_types[place] for place in places]
    bodies = RigidBody.from_urdf(profile.urdf, joints, types, name=profile.name)
    if bodies.order != tuple(range(len(bodies.order))):
        raise ValueError(f"the joints of {profile.name!r} are {', '.join(joints)}, expected them from base to tip")
    called = bodies.joint_names if names is None else names
    _check(profile, bodies.joint_names, called)
    every = Limits.of_profile(profile)
    parts = (getattr(every, name)[places] for name in ("lower", "upper", "speed", "acceleration", "torque"))
    limits = Limits(called, *parts)
    robot = Robot(profile.name, bodies.model, called, bodies.joint_types, limits.lower, limits.upper, limits.speed)
    return Arm(profile.name, limits, robot, replace(bodies, joint_names=called))


def _check(profile: Profile, own: Sequence[str], called: Sequence[str]) -> None:
    """The model's joints are the robot's, in the same order, whatever they are called."""
    known = profile.called(called)
    if len(own) != len(called) or (known is not None and known != tuple(own)):
        raise ValueError(
            f"robot {profile.name!r} has the joints {', '.join(own)}; the model has {', '.join(called)}, expected as "
            "many in the same order"
        )

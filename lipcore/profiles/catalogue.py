"""The robots with a profile, and those among them that match a recording's joint names."""

from __future__ import annotations

import tomllib
from collections.abc import Container, Sequence
from dataclasses import replace
from functools import cache, lru_cache
from importlib import resources
from typing import Any

import msgspec
import numpy as np

from lipcore.profiles.names import find_makes, is_number
from lipcore.profiles.profile import Limits, Profile, ProfileEntry, array_or_nan, read_limits
from lipcore.robots.library import ROBOTS, UnknownRobotError, list_installed_robots, profile_urdf
from lipcore.vocabulary import JointType

REVOLUTE: tuple[JointType, ...] = ("revolute",)


@cache
def read_entries() -> dict[str, ProfileEntry]:
    """Return the robots of `arms.toml` by name."""
    text = resources.files(__package__).joinpath("arms.toml").read_text("utf-8")
    entries: dict[str, dict[str, Any]] = {}
    for family in tomllib.loads(text)["family"]:
        robots = family.pop("robots")
        entries |= {
            name: {"joints": ROBOTS[name].free if name in ROBOTS else (), **family, **robot}
            for name, robot in robots.items()
        }
    return msgspec.convert(entries, dict[str, ProfileEntry])


def profiles() -> tuple[Profile, ...]:
    """Return every robot with a profile on this machine; some need example-robot-data."""
    installed = list_installed_robots()
    return tuple(_profile(name, name in installed) for name in _names(installed))


def names() -> tuple[str, ...]:
    """Return the names of the robots that `profile` returns on this machine."""
    return _names(list_installed_robots())


def profile(name: str) -> Profile:
    """Return the profile of a robot by name; raise UnknownRobotError naming the robots with a profile."""
    installed = list_installed_robots()
    known = _names(installed)
    if name not in known:
        raise UnknownRobotError(f"robot is {name!r}, expected one of {', '.join(known)}")
    return _profile(name, name in installed)


def _names(installed: Container[str]) -> tuple[str, ...]:
    return tuple(name for name, sheet in read_entries().items() if sheet.ranges is not None or name in installed)


def recognise(joint_names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the robots that may have these joints, those with the most joints first.

    Joints that only have numbers match no robot, because every robot has them.
    """
    mentioned = frozenset().union(*map(find_makes, joint_names))
    fitting = []
    for each in profiles():
        all_there = any(
            len(reading) == each.n_joints for reading in each.list_assignments(joint_names, bool(mentioned))
        )
        telling = mentioned or not all(is_number(name) for name in each.joint_names)
        if all_there and telling and mentioned <= each.makes:
            fitting.append(each)
    return tuple(each.name for each in sorted(fitting, key=lambda each: -each.n_joints))


@lru_cache(maxsize=128)
def _profile(name: str, installed: bool) -> Profile:
    sheet = read_entries()[name]
    n_joints = len(sheet.joints)
    urdf = profile_urdf(name) if installed else None
    if sheet.ranges is not None:
        lower, upper = np.array(sheet.ranges).T
        speed = array_or_nan(sheet.speed, n_joints)
        if sheet.degrees:
            lower, upper, speed = map(np.radians, (lower, upper, speed))
        limits = Limits(REVOLUTE * n_joints, lower, upper, speed, array_or_nan(sheet.torque, n_joints))
    else:
        assert urdf is not None, f"{name} has neither ranges nor a URDF"
        limits = read_limits(urdf, sheet.joints)
        if sheet.placeholders:
            limits = replace(limits, speed=array_or_nan(None, n_joints), torque=array_or_nan(None, n_joints))
    return Profile(
        name=name,
        title=sheet.title,
        joint_names=sheet.joints,
        joint_types=limits.types,
        lower=limits.lower,
        upper=limits.upper,
        speed=limits.speed,
        acceleration=array_or_nan(sheet.acceleration, n_joints),
        torque=limits.torque,
        effort=sheet.effort,
        effort_note=sheet.effort_note,
        torque_constants=None,
        joint_aliases=sheet.aliases or ((),) * n_joints,
        urdf=urdf,
        source=sheet.source.format(name=name) + sheet.remark,
    )

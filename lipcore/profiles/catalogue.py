"""The robots that are known by name, and which of them a recording's joint names fit."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from lipcore.profiles.arms import ARMS
from lipcore.profiles.names import is_number, makes
from lipcore.profiles.profile import Limits, Profile, Sheet, array, read_limits
from lipcore.robots.library import ROBOTS, UnknownRobotError, installed_profiles, profile_urdf
from lipcore.vocabulary import JointType

_URDF = "URDF of example-robot-data"
_SAY = "Say what the effort of your recordings is with `effort`."
_BAXTER = (
    "The effort that its springs' deflection measures, gravity included. Commanded torque is added to the robot's own "
    "gravity compensation: upload it as `commanded`."
)
_TOY = "A small test rig: what its effort is depends on your drives. " + _SAY


def _sheet(name: str, title: str, effort_note: str = _SAY, measured: bool = False) -> Sheet:
    return Sheet(title, ROBOTS[name].free, "measured" if measured else "unknown", effort_note, _URDF)


OTHERS: dict[str, Sheet] = {
    "baxter-left": _sheet("baxter-left", "Rethink Baxter, left arm", _BAXTER, measured=True),
    "baxter-right": _sheet("baxter-right", "Rethink Baxter, right arm", _BAXTER, measured=True),
    "pr2-left": _sheet("pr2-left", "Willow Garage PR2, left arm"),
    "pr2-right": _sheet("pr2-right", "Willow Garage PR2, right arm"),
    "talos-left": _sheet("talos-left", "PAL TALOS, left arm without its first joint"),
    "tiago": _sheet("tiago", "PAL TIAGo, lift and arm"),
    "tiago-pro-left": _sheet("tiago-pro-left", "PAL TIAGo Pro, left arm"),
    "tiago-pro-right": _sheet("tiago-pro-right", "PAL TIAGo Pro, right arm"),
    "double-pendulum": _sheet("double-pendulum", "Double pendulum", _TOY),
    "asr-twodof": _sheet("asr-twodof", "Two-joint arm of ASR", _TOY),
    "finger-edu": replace(
        _sheet("finger-edu", "FingerEdu of the Open Dynamic Robot Initiative", _TOY),
        source=f"{_URDF} for the ranges; its limits of speed and torque, 1000, are placeholders and left out",
        placeholders=True,
    ),
}
"""Arms that example-robot-data alone describes: there is a profile where that package is installed."""
SHEETS: dict[str, Sheet] = ARMS | OTHERS
REVOLUTE: tuple[JointType, ...] = ("revolute",)


def profiles() -> tuple[Profile, ...]:
    """Every robot that is known here; some are only where example-robot-data is installed."""
    installed = installed_profiles()
    return tuple(_profile(name, name in installed) for name in _names(installed))


def names() -> tuple[str, ...]:
    """Names of the robots that `profile` returns here."""
    return _names(installed_profiles())


def profile(name: str) -> Profile:
    """The profile of a robot by name; raise UnknownRobotError naming those that are known here."""
    installed = installed_profiles()
    known = _names(installed)
    if name not in known:
        raise UnknownRobotError(f"robot is {name!r}, expected one of {', '.join(known)}")
    return _profile(name, name in installed)


def _names(installed: Container[str]) -> tuple[str, ...]:
    return tuple(name for name, sheet in SHEETS.items() if sheet.numbers is not None or name in installed)


def recognise(joint_names: Sequence[str]) -> tuple[str, ...]:
    """Names of the robots that these joints may be of, those with the most joints first; none for joints that only
    have numbers, which every robot has.
    """
    mentioned = frozenset().union(*map(makes, joint_names))
    fitting = []
    for each in profiles():
        all_there = any(len(reading) == each.n_joints for reading in each.readings(joint_names, bool(mentioned)))
        telling = mentioned or not all(is_number(name) for name in each.joint_names)
        if all_there and telling and mentioned <= each.makes:
            fitting.append(each)
    return tuple(each.name for each in sorted(fitting, key=lambda each: -each.n_joints))


@lru_cache(maxsize=128)
def _profile(name: str, installed: bool) -> Profile:
    sheet, n_joints = SHEETS[name], len(SHEETS[name].joints)
    urdf = profile_urdf(name) if installed else None
    numbers = sheet.numbers
    if numbers is not None:
        lower, upper = np.array(numbers.ranges, dtype=np.float64).T
        limits = Limits(
            REVOLUTE * n_joints, lower, upper, array(numbers.speed, n_joints), array(numbers.torque, n_joints)
        )
    else:
        assert urdf is not None, f"{name} has neither numbers nor a URDF"
        limits = read_limits(urdf, ROBOTS[name].free)
        if sheet.placeholders:
            limits = replace(limits, speed=array(None, n_joints), torque=array(None, n_joints))
    return Profile(
        name=name,
        title=sheet.title,
        joint_names=sheet.joints,
        joint_types=limits.types,
        lower=limits.lower,
        upper=limits.upper,
        speed=limits.speed,
        acceleration=array(None if numbers is None else numbers.acceleration, n_joints),
        torque=limits.torque,
        effort=sheet.effort,
        effort_note=sheet.effort_note,
        torque_constants=None,
        joint_aliases=sheet.aliases or ((),) * n_joints,
        urdf=urdf,
        source=sheet.source,
    )

"""The joints of a recording: their names, selection and order."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from lipcore.profiles import Profile
from service.datasets.mapping.recognition import JOINT, Family, JointKey
from service.datasets.options import UploadOptions
from service.foundation.errors import InvalidDataError, invalid_data, invalid_request
from service.foundation.fields import first_repeat

MAX_NAME_CHARS = 100
WARNING = "warning: "
"""Prefix of sentences that belong to the warnings of a report."""
_NUMBER = re.compile(r"\d{1,9}")
_WORD = re.compile(r"[A-Za-z]+|\d+")
_MAX_LISTED = 12


@dataclass(frozen=True)
class Joint:
    """A joint of the file."""

    key: JointKey
    label: str
    """Name in the file."""
    name: str
    index: int
    """Index of the column of its position."""
    place: int
    """Index among all joints of the file."""
    of: int
    """Number of joints of the file."""


@dataclass(frozen=True)
class JointOrder:
    """Joints that are kept, in order, and joints that are left out; constants: N·m/A of those kept, if known."""

    kept: tuple[Joint, ...]
    dropped: tuple[Joint, ...]
    constants: tuple[float, ...] | None
    notes: tuple[str, ...]


def list_joints(positions: Family) -> tuple[Joint, ...]:
    """Return all joints of a file, ordered by number if they have numbers, else as in the file."""
    items = list(positions.members.items())
    if not positions.listed:
        items.sort(key=_number_key(positions))
    return tuple(
        Joint(
            key,
            member.label,
            member.label.strip() if any(map(str.isalpha, member.label)) else f"joint{key}",
            member.index,
            place,
            len(items),
        )
        for place, (key, member) in enumerate(items)
    )


def arrange_joints(
    positions: Family,
    joint_names: tuple[str, ...] | None,
    options: UploadOptions,
    robot: Profile | None,
    max_joints: int,
) -> JointOrder:
    """Name, select and order the joints by the options and the robot; raise InvalidDataError."""
    _check_numbers(positions)
    joints = _name_joints(list_joints(positions), joint_names, options)
    chosen, left_out = _select_joints(joints, options)
    notes: list[str] = []
    constants = None
    kept: tuple[Joint, ...] = chosen
    if robot is not None:
        kept, constants, notes = _match_robot(joints, chosen, options, robot)
        left_out += tuple(joint for joint in chosen if joint.index not in {each.index for each in kept})
    if not 1 <= len(kept) <= max_joints:
        raise invalid_data("joints", len(kept), f"1 to {max_joints}")
    if robot is None and (arms := _find_arms([joint.name for joint in kept])):
        several = " and ".join(f"{each[0]} to {each[-1]}" for each in arms[:_MAX_LISTED])
        notes.append(
            f"{WARNING}By their names, these are the joints of {len(arms)} arms: {several}. "
            "To learn them in one model, set `robot` to a URDF with all arms, or train with the option arms="
            f"{','.join(str(len(each)) for each in arms)}. To learn one alone: joints={','.join(arms[0])}."
        )
    if robot is None and _is_alphabetical(kept):
        notes.append(
            "the joints are in alphabetical order, as some drivers list them: if this is not from base to tip, set the "
            "order with `joints` or set `robot`"
        )
    if [joint.index for joint in kept] != sorted(joint.index for joint in kept):
        notes.append(f"joints were put in the order {', '.join(joint.name for joint in kept)}")
    names = options.read.joint_names
    if names is not None and len(names) == len(kept) != len(joints):
        kept = tuple(replace(joint, name=name) for joint, name in zip(kept, names, strict=True))
    check_names(tuple(joint.name for joint in kept))
    return JointOrder(kept, left_out, constants, tuple(notes))


def check_names(names: tuple[str, ...]) -> None:
    """Raise InvalidDataError if joint names are repeated or not printable."""
    for index, name in enumerate(names):
        if not name or len(name) > MAX_NAME_CHARS or not name.isprintable():
            raise invalid_data(f"joint_names[{index}]", name, f"1 to {MAX_NAME_CHARS} printable characters")
    if (twice := first_repeat(names)) is not None:
        raise invalid_data(f"joint_names[{twice}]", names[twice], "a different name for each joint")


def _check_numbers(positions: Family) -> None:
    """Raise InvalidDataError if joints have only numbers and a number is missing."""
    labels = [member.label for member in positions.members.values()]
    if positions.listed or not all(label.isdecimal() for label in labels):
        return
    numbers = sorted(key for key in positions.members if isinstance(key, int))
    first = min(map(int, labels))
    # numbers start at 0 or 1 in the file, at 1 in the keys
    missing = next((place for place, key in enumerate(numbers, start=1) if key != place), None)
    if missing is not None and len(numbers) > 1:
        name = positions.pattern.replace(JOINT, str(missing - (first == 0)))
        raise invalid_data(f"column {name}", "missing", f"positions of joints {first or 1} to {max(map(int, labels))}")


def _number_key(positions: Family) -> Callable[[tuple[JointKey, object]], tuple[int, ...]]:
    labels = {key: member.label for key, member in positions.members.items()}
    alike = len({_NUMBER.sub("#", label) for label in labels.values()}) == 1
    if not alike and not positions.numbered:
        return lambda item: ()
    return lambda item: tuple(int(each) for each in _NUMBER.findall(labels[item[0]])) or (0,)


def _name_joints(
    joints: tuple[Joint, ...], joint_names: tuple[str, ...] | None, options: UploadOptions
) -> tuple[Joint, ...]:
    names = options.read.joint_names
    kept = len(joints) - len(options.drop_joints) if options.joints is None else len(options.joints)
    if names is not None and len(names) == len(joints):
        return tuple(replace(joint, name=name) for joint, name in zip(joints, names, strict=True))
    if names is not None and len(names) != kept:
        raise invalid_data("joint_names", f"{len(names)} names", f"{len(joints)} names, one per joint")
    # use the separate joint names of a file only if its columns have numbers
    if joint_names is not None and len(joint_names) == len(joints) and all(isinstance(j.key, int) for j in joints):
        return tuple(replace(joint, name=name) for joint, name in zip(joints, joint_names, strict=True))
    return joints


def _select_joints(joints: tuple[Joint, ...], options: UploadOptions) -> tuple[tuple[Joint, ...], tuple[Joint, ...]]:
    dropped = [_find_joint(joints, name, "drop_joints") for name in options.drop_joints]
    asked = list(joints) if options.joints is None else [_find_joint(joints, name, "joints") for name in options.joints]
    if len({joint.index for joint in asked}) < len(asked):
        raise invalid_request("joints", ", ".join(options.joints or ()), "each joint only once")
    kept = tuple(joint for joint in asked if joint not in dropped)
    return kept, tuple(joint for joint in joints if joint not in kept)


def _find_joint(joints: tuple[Joint, ...], name: str, option: str) -> Joint:
    for joint in joints:
        if name.lower() in (joint.name.lower(), joint.label.lower()):
            return joint
    raise invalid_data(option, name, f"one of the joints of the file: {_listed([joint.name for joint in joints])}")


def _match_robot(
    joints: tuple[Joint, ...], chosen: tuple[Joint, ...], options: UploadOptions, robot: Profile
) -> tuple[tuple[Joint, ...], tuple[float, ...] | None, list[str]]:
    """Return the chosen joints that the robot has, from base to tip and with its names, their constants, and notes."""
    notes, names = [], robot.joint_names
    constants = None if robot.torque_constants is None else list(robot.torque_constants)
    among = joints if options.joints is None else chosen
    places = robot.order_of([joint.name for joint in among])
    if places is None and options.read.joint_names is not None:
        places = robot.order_of([joint.label for joint in among])
    if places is None:
        if len(arms := robot.list_assignments([joint.name for joint in among])) > 1:
            raise _ambiguous(robot, [[among[each[joint]].name for joint in sorted(each)] for each in arms])
        if len(chosen) != len(names) or not (options.read.joint_names or all(isinstance(j.key, int) for j in chosen)):
            raise _mismatch(robot, chosen)
        ordered = list(chosen)
        notes.append(f"joints are assigned to those of {robot.name} by their order")
    else:
        ordered = [among[place] for place in places]
    called = {joint.index: place for place, joint in enumerate(ordered)} if len(ordered) == len(names) else {}
    kept = [joint for joint in ordered if joint in chosen]
    others = [joint for joint in chosen if joint not in ordered]
    if options.joints is not None:
        if [joint for joint in chosen if joint in kept] != kept:
            expected = f"the order of {robot.name}: {_listed([joint.name for joint in kept])}"
            raise invalid_request("joints", ", ".join(options.joints), expected)
        kept, others = list(chosen), []
    if others:
        notes.append(
            f"joints left out because {robot.name} does not have them: {_listed([joint.name for joint in others])}"
        )
    if options.read.joint_names is None:
        renamed = [replace(j, name=names[called[j.index]]) if j.index in called else j for j in kept]
        if any(a.name != b.name for a, b in zip(kept, renamed, strict=True)):
            pairs = [f"{a.name} → {b.name}" for a, b in zip(kept, renamed, strict=True) if a.name != b.name]
            notes.append(f"joints are renamed to those of {robot.name}: {_listed(pairs)}")
        kept = renamed
    known = constants is not None and all(joint.index in called for joint in kept)
    values = tuple(float(constants[called[joint.index]]) for joint in kept) if known and constants else None
    return tuple(kept), values, notes


def _mismatch(robot: Profile, chosen: Sequence[Joint]) -> InvalidDataError:
    return invalid_data(
        "joints",
        _listed([joint.name for joint in chosen]),
        f"the joints of {robot.name}: {_listed(robot.joint_names)}. Set `joint_names` to the robot's names in the "
        "order of the file, or leave out other joints with `drop_joints`",
    )


def _ambiguous(robot: Profile, arms: Sequence[Sequence[str]]) -> InvalidDataError:
    several = " and ".join(f"{each[0]} to {each[-1]}" for each in arms[:_MAX_LISTED])
    expected = f"those of one {robot.name}. Choose one, for example with joints={','.join(arms[0])}"
    return invalid_data("joints", f"those of several arms: {several}", expected)


def _find_arms(names: Sequence[str]) -> list[list[str]]:
    """Return the joints of each arm if the names differ in one word per arm, such as left and right; else none."""
    words = [_WORD.findall(name) for name in names]
    for place in (0, 1, -1):
        arms: dict[str, dict[tuple[str, ...], str]] = {}
        for name, each in zip(names, words, strict=True):
            if len(each) <= max(place, 1) or each[place].isdecimal():
                break
            rest = tuple(each[:place] + each[place:][1:])
            arms.setdefault(each[place], {})[rest] = name
        else:
            joints = list(arms.values())
            if len(joints) > 1 and len(joints[0]) > 2 and all(each.keys() == joints[0].keys() for each in joints):
                return [list(each.values()) for each in joints]
    return []


def _is_alphabetical(joints: Sequence[Joint]) -> bool:
    names = [joint.name for joint in joints]
    numbered = len({_NUMBER.sub("#", name) for name in names}) < len(names)
    return len(names) > 2 and not numbered and names == sorted(names)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:_MAX_LISTED]) + (" …" if len(names) > _MAX_LISTED else "")

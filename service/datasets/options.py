"""How an upload is to be read and prepared: the texts of a query, read."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lipcore.preparation.recipe import Recipe
from lipcore.vocabulary import TorqueConvention
from service.contract.uploads import Effort, UploadQuery
from service.foundation.errors import invalid_request
from service.foundation.json_text import read_json

EFFORT_CONVENTIONS: Mapping[Effort, TorqueConvention] = {
    "measured": "gravity_included",
    "commanded": "gravity_compensated",
    "current": "gravity_included",
}


@dataclass(frozen=True)
class ReadOptions:
    """How a file becomes columns. All may be None: then it is found out, or the robot says.

    columns: for t, episode, q, dq, ddq, tau what its columns are called: a pattern with `{joint}`, or a list; units: of
    these by name; topic: of a bag; delimiter: of a CSV; joint_names: of joints 1..n; effort: what tau is;
    torque_constants: N·m/A a joint, of motor currents; torque_factors: by which each joint's torque is multiplied;
    column_names: of text that has none; dt: s between rows that have no times.
    """

    columns: Mapping[str, str | tuple[str, ...]] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    topic: str | None = None
    delimiter: str | None = None
    joint_names: tuple[str, ...] | None = None
    effort: Effort | None = None
    torque_constants: tuple[float, ...] | None = None
    torque_factors: tuple[float, ...] | None = None
    column_names: tuple[str, ...] | None = None
    dt: float | None = None


@dataclass(frozen=True)
class UploadOptions:
    """What an upload is taken as.

    robot: a profile's name or the id of an uploaded URDF; torque_convention: None takes that of the effort; joints:
    those to keep, in this order, None keeps all; drop_joints: those to leave out, which then must not move.
    """

    read: ReadOptions = field(default_factory=ReadOptions)
    recipe: Recipe = field(default_factory=Recipe)
    robot: str | None = None
    torque_convention: TorqueConvention | None = None
    joints: tuple[str, ...] | None = None
    drop_joints: tuple[str, ...] = ()


QUANTITIES = ("t", "episode", "q", "dq", "ddq", "tau")
MOST_NAMES = 1000
MOST_NAME = 200


def upload_options(query: UploadQuery) -> UploadOptions:
    """Read the texts of a query; raise InvalidRequestError for one that has no such meaning."""
    read = ReadOptions(
        columns=_columns(query.columns),
        units=_units(query.units),
        topic=query.topic,
        delimiter=query.delimiter,
        joint_names=_names("joint_names", query.joint_names),
        effort=query.effort,
        torque_constants=_numbers("torque_constants", query.torque_constants, "N·m/A"),
        torque_factors=_numbers("torque_factors", query.torque_factors, "no unit"),
        column_names=_ranges("column_names", query.column_names),
        dt=query.dt,
    )
    recipe = Recipe(
        cutoff_hz=query.cutoff,
        filtering=query.filtering,
        form=query.form,
        rate_hz=query.rate,
        trim_s=query.trim,
        gap_steps=query.gap,
    )
    dropped = _names("drop_joints", query.drop_joints)
    return UploadOptions(
        read, recipe, query.robot, query.torque_convention, _names("joints", query.joints), dropped or ()
    )


def _names(field: str, given: str | None) -> tuple[str, ...] | None:
    if given is None:
        return None
    names = tuple(part.strip() for part in given.split(","))
    if len(names) > MOST_NAMES:
        raise invalid_request(field, f"{len(names)} names", f"at most {MOST_NAMES}")
    return names


_RANGE = re.compile(r"(.*?)(\d{1,4})\.\.(.*?)(\d{1,4})")


def _ranges(field: str, given: str | None) -> tuple[str, ...] | None:
    """Names of columns, ranges of them written out: `q1..q3` stands for q1, q2, q3."""
    names: list[str] = []
    for name in _names(field, given) or ():
        match = _RANGE.fullmatch(name)
        if match is None:
            names.append(name)
            continue
        first, last = int(match[2]), int(match[4])
        if match[3] not in ("", match[1]) or not first <= last < first + MOST_NAMES:
            raise invalid_request(field, name, "a range of names such as q1..q7")
        names += [f"{match[1]}{number}" for number in range(first, last + 1)]
    return tuple(names) if names else None


def _numbers(field: str, given: str | None, unit: str) -> tuple[float, ...] | None:
    values = []
    for text in [] if given is None else given.split(","):
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not 0 < abs(value) < 1e6:
            raise invalid_request(field, text, f"numbers of {unit}, none of them 0, separated by commas")
        values.append(value)
    return None if given is None else tuple(values)


def _object(field: str, given: str | None) -> Mapping[str, Any]:
    if given is None:
        return {}
    parsed = read_json(given.encode())
    if not isinstance(parsed, dict):
        raise invalid_request(field, given, f"a JSON object with any of {', '.join(QUANTITIES)}")
    for name in parsed:
        if name not in QUANTITIES:
            raise invalid_request(f"{field}.{name}", parsed[name], f"any of {', '.join(QUANTITIES)}")
    return parsed


def _columns(given: str | None) -> dict[str, str | tuple[str, ...]]:
    columns: dict[str, str | tuple[str, ...]] = {}
    for name, value in _object("columns", given).items():
        several = isinstance(value, list) and 0 < len(value) <= MOST_NAMES
        if not all(isinstance(each, str) and 0 < len(each) <= MOST_NAME for each in (value if several else [value])):
            raise invalid_request(f"columns.{name}", value, "the name of a column, a pattern with {joint}, or a list")
        columns[name] = tuple(value) if several else value
    return columns


def _units(given: str | None) -> dict[str, str]:
    units = _object("units", given)
    for name, value in units.items():
        if not isinstance(value, str) or not 0 < len(value) <= MOST_NAME:
            raise invalid_request(f"units.{name}", value, "the name of a unit, such as deg")
    return dict(units)

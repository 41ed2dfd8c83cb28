"""Options for reading and preparing an upload, parsed from its query."""

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
    """How a file becomes columns. An option that is None is detected, or comes from the robot's profile."""

    columns: Mapping[str, str | tuple[str, ...]] = field(default_factory=dict)
    """Column names of t, episode, q, dq, ddq and tau: a pattern with `{joint}`, or a list."""
    units: Mapping[str, str] = field(default_factory=dict)
    """Units by the same keys."""
    topic: str | None = None
    """Topic of a bag, group of an HDF5 file, or sheet of a workbook."""
    delimiter: str | None = None
    """Delimiter of a CSV."""
    joint_names: tuple[str, ...] | None = None
    """Names of joints 1..n."""
    effort: Effort | None = None
    """What the torque column holds."""
    torque_constants: tuple[float, ...] | None = None
    """Torque constant of each joint for motor currents, N·m/A."""
    torque_factors: tuple[float, ...] | None = None
    """Factor on each joint's torque."""
    column_names: tuple[str, ...] | None = None
    """Column names of text without a header."""
    dt: float | None = None
    """Time between rows without times, s."""
    poses: bool = False
    """Whether every row is a held pose."""


@dataclass(frozen=True)
class UploadOptions:
    """Options of an upload."""

    read: ReadOptions = field(default_factory=ReadOptions)
    recipe: Recipe = field(default_factory=Recipe)
    robot: str | None = None
    """Profile name, or id of an uploaded URDF."""
    torque_convention: TorqueConvention | None = None
    """None: the convention that the effort implies."""
    joints: tuple[str, ...] | None = None
    """Joints to keep, in this order; None keeps all."""
    drop_joints: tuple[str, ...] = ()
    """Joints to leave out, which must not move."""


QUANTITIES = ("t", "episode", "q", "dq", "ddq", "tau")
MAX_LIST_NAMES = 1000
MAX_COLUMN_CHARS = 200


def upload_options(query: UploadQuery) -> UploadOptions:
    """Parse the texts of a query; raise InvalidRequestError if one is malformed."""
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
        poses=query.poses,
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
    if len(names) > MAX_LIST_NAMES:
        raise invalid_request(field, f"{len(names)} names", f"at most {MAX_LIST_NAMES}")
    return names


_RANGE = re.compile(r"(.*?)(\d{1,4})\.\.(.*?)(\d{1,4})")


def _ranges(field: str, given: str | None) -> tuple[str, ...] | None:
    """Return names of columns, with ranges expanded: `q1..q3` is q1, q2, q3."""
    names: list[str] = []
    for name in _names(field, given) or ():
        match = _RANGE.fullmatch(name)
        if match is None:
            names.append(name)
            continue
        first, last = int(match[2]), int(match[4])
        if match[3] not in ("", match[1]) or not first <= last < first + MAX_LIST_NAMES:
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
            raise invalid_request(field, text, f"nonzero numbers ({unit}) below 1e6, separated by commas")
        values.append(value)
    return None if given is None else tuple(values)


def _object(field: str, given: str | None) -> Mapping[str, Any]:
    if given is None:
        return {}
    parsed = read_json(given.encode())
    if not isinstance(parsed, dict):
        raise invalid_request(field, given, f"a JSON object with keys of {', '.join(QUANTITIES)}")
    for name in parsed:
        if name not in QUANTITIES:
            raise invalid_request(f"{field}.{name}", parsed[name], f"one of {', '.join(QUANTITIES)}")
    return parsed


def _columns(given: str | None) -> dict[str, str | tuple[str, ...]]:
    columns: dict[str, str | tuple[str, ...]] = {}
    for name, value in _object("columns", given).items():
        several = isinstance(value, list) and 0 < len(value) <= MAX_LIST_NAMES
        if not all(
            isinstance(each, str) and 0 < len(each) <= MAX_COLUMN_CHARS for each in (value if several else [value])
        ):
            raise invalid_request(
                f"columns.{name}", value, "a column name, a pattern with {joint}, or a list of column names"
            )
        columns[name] = tuple(value) if several else value
    return columns


def _units(given: str | None) -> dict[str, str]:
    units = _object("units", given)
    for name, value in units.items():
        if not isinstance(value, str) or not 0 < len(value) <= MAX_COLUMN_CHARS:
            raise invalid_request(f"units.{name}", value, "the name of a unit, such as deg")
    return dict(units)

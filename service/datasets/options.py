"""How an upload is to be read and prepared: the query of its route, and what the command line passes on."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from fastapi import Query

from lipcore.data.signals import CUTOFF
from lipcore.preparation.recipe import Filtering, Form, Recipe
from lipcore.vocabulary import TorqueConvention
from lipserve.asking import MEDIA_TYPES, SUFFIXES
from service.foundation.errors import invalid_request
from service.foundation.fields import BINARY, upload_body
from service.web.route import read_json

Effort = Literal["measured", "commanded", "current"]
"""What the effort of a recording is: measured torque, gravity included; commanded torque, what is added to gravity
compensation; motor current, A, that torque constants turn into torque."""
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
MOST_TEXT = 8000
MOST_NAMES = 1000
MOST_NAME = 200

Text = Annotated[str | None, Query(max_length=200)]
Names = Annotated[str | None, Query(max_length=MOST_TEXT)]
Positive = Annotated[float | None, Query(gt=0, le=1e6, allow_inf_nan=False)]


UPLOAD_BODY = upload_body(
    "A recording with at least positions, torques and times. Canonical columns are `t` (s), `q1..qn`, `dq1..`, "
    "`ddq1..`, `tau1..`, optional `episode`, in SI units; other names and units are recognised or declared by "
    "`columns` and `units`. `dq` and `ddq` may be absent and are then derived. NPZ holds `q`, `dq`, `ddq`, `tau` "
    "(N, n), `t` or `dt`, `episode`, `joint_names`; bags hold `sensor_msgs/JointState` or the states of a Franka; a "
    "zip is the directory of a LeRobot data set or of a rosbag2, or holds tables of text that are joined side by side: "
    "positions.txt, velocities.txt, torques.txt may then lack column names.",
    {
        "text/csv": {"schema": {"type": "string"}, "example": "t,q1,dq1,ddq1,tau1\n0.0,0.1,0.0,0.2,1.5\n"},
        "application/x-ndjson": {
            "schema": {"type": "string"},
            "example": '{"t": 0.0, "q": [0.1], "dq": [0.0], "tau": [1.5]}\n',
        },
        **{kind: {"schema": BINARY} for kind in MEDIA_TYPES if kind not in ("text/csv", "application/x-ndjson")},
    },
    f"A file whose name ends in {', '.join(SUFFIXES)}",
)


async def upload_options(
    joint_names: Annotated[Names, Query(description="Names of joints 1..n, separated by commas")] = None,
    robot: Annotated[
        Text, Query(description="A profile such as panda, or the id of an uploaded URDF: its limits, joints, effort")
    ] = None,
    torque_convention: Annotated[
        TorqueConvention | None,
        Query(
            description="Whether `tau` is the whole joint torque or what is added to gravity; by default what the "
            "effort of the robot means, else the whole"
        ),
    ] = None,
    effort: Annotated[
        Effort | None,
        Query(
            description="What the column of torque holds: measured torque, gravity included; commanded torque without "
            "gravity; or motor current, A, which needs torque constants. By default what the robot's profile says"
        ),
    ] = None,
    torque_constants: Annotated[
        Names, Query(description="N·m/A of joints 1..n, separated by commas, for motor currents")
    ] = None,
    torque_factors: Annotated[
        Names,
        Query(
            description="By which the torques of joints 1..n are multiplied, separated by commas: -1 where the sign is "
            "opposite, or a gear's ratio"
        ),
    ] = None,
    joints: Annotated[Names, Query(description="Joints to keep, in this order; all by default")] = None,
    drop_joints: Annotated[Names, Query(description="Joints to leave out: grippers, those that are locked")] = None,
    columns: Annotated[
        Names,
        Query(
            description="What the file calls its columns, as JSON: for `t`, `episode`, `q`, `dq`, `ddq`, `tau` a "
            'pattern such as `{"q": "{joint}/position"}`, or a list of names. Found out where not given'
        ),
    ] = None,
    units: Annotated[
        Names,
        Query(description='Units of columns as JSON, such as `{"q": "deg", "t": "ms"}`; SI, or as the header says'),
    ] = None,
    topic: Annotated[Text, Query(description="Topic of a bag, where several could be read")] = None,
    delimiter: Annotated[
        str | None, Query(min_length=1, max_length=1, description="Of a CSV; found out where not given")
    ] = None,
    column_names: Annotated[
        Names,
        Query(description="Names of the columns of text that has none, separated by commas; `q1..q7` stands for seven"),
    ] = None,
    dt: Annotated[
        float | None, Query(gt=0, le=100, allow_inf_nan=False, description="s from row to row, of a file without times")
    ] = None,
    cutoff: Annotated[float, Query(gt=0, le=1000, allow_inf_nan=False, description="Of the low-pass, Hz")] = CUTOFF,
    filtering: Annotated[
        Filtering,
        Query(description="When signals are low-passed: where velocity or acceleration is `derived`, always, or never"),
    ] = "derived",
    form: Annotated[
        Form, Query(description="`causal` prepares as a live stream could be, late; `acausal` without delay")
    ] = "acausal",
    rate: Annotated[Positive, Query(description="Of the samples that come out, Hz; as recorded by default")] = None,
    gap: Annotated[
        float,
        Query(gt=1, le=1e6, allow_inf_nan=False, description="A step of time that splits a recording, in usual steps"),
    ] = 1.5,
    trim: Annotated[
        float | None,
        Query(
            ge=0,
            le=1e6,
            allow_inf_nan=False,
            description="Cut off at both ends of every part, s; what the filter spoils by default",
        ),
    ] = None,
) -> UploadOptions:
    """How an upload is read and prepared; raise InvalidRequestError."""
    read = ReadOptions(
        columns=_columns(columns),
        units=_units(units),
        topic=topic,
        delimiter=delimiter,
        joint_names=_names("joint_names", joint_names),
        effort=effort,
        torque_constants=_numbers("torque_constants", torque_constants, "N·m/A"),
        torque_factors=_numbers("torque_factors", torque_factors, "no unit"),
        column_names=_ranges("column_names", column_names),
        dt=dt,
    )
    recipe = Recipe(cutoff_hz=cutoff, filtering=filtering, form=form, rate_hz=rate, trim_s=trim, gap_steps=gap)
    dropped = _names("drop_joints", drop_joints)
    return UploadOptions(read, recipe, robot, torque_convention, _names("joints", joints), dropped or ())


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

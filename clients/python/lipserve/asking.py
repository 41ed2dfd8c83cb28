"""How a client asks for an upload: the route's query from Python values."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, TypedDict


class Reading(TypedDict, total=False):
    """What a client may say of an upload; what is left out is found out, or takes the route's default.

    joint_names, joints, drop_joints: names; torque_constants: N·m/A; torque_factors: of the torques; columns: for t,
    episode, q, dq, ddq, tau a pattern with `{joint}` or a list of names; units: of these by name; column_names:
    of text that has none; dt: s from row to row, where there are no times; cutoff, rate: Hz;
    gap: usual steps of time; trim: s. The others are as in the route's documentation.
    """

    joint_names: Sequence[str]
    robot: str
    torque_convention: str
    effort: str
    torque_constants: Sequence[float]
    torque_factors: Sequence[float]
    joints: Sequence[str]
    drop_joints: Sequence[str]
    columns: Mapping[str, str | Sequence[str]]
    units: Mapping[str, str]
    topic: str
    delimiter: str
    column_names: Sequence[str]
    dt: float
    cutoff: float
    filtering: str
    form: str
    rate: float
    gap: float
    trim: float


def query_of(reading: Reading) -> dict[str, str]:
    """The query parameters that say it."""
    return {name: _text(value) for name, value in reading.items() if value is not None}


def _text(value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, Mapping):
        return json.dumps({name: each if isinstance(each, str) else list(each) for name, each in value.items()})
    if isinstance(value, Sequence):
        return ",".join(map(str, value))
    return str(value)

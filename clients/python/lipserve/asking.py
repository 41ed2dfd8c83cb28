"""Options of an upload, and the query parameters made from them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, TypedDict


class Reading(TypedDict, total=False):
    """Options for reading and preparing an upload; missing ones are detected or take the service's default."""

    joint_names: Sequence[str]
    """Names of joints 1 to n."""
    robot: str
    """Profile such as panda, or id of an uploaded URDF."""
    torque_convention: str
    """`gravity_included` or `gravity_compensated`."""
    effort: str
    """Meaning of tau: `measured`, `commanded` or `current`."""
    torque_constants: Sequence[float]
    """(n,) N·m/A, for motor currents."""
    torque_factors: Sequence[float]
    """(n,) factors on the torques; -1 reverses the sign."""
    joints: Sequence[str]
    """Joints to keep, in this order."""
    drop_joints: Sequence[str]
    """Joints to drop."""
    columns: Mapping[str, str | Sequence[str]]
    """Columns of t, episode, q, dq, ddq, tau: a pattern with `{joint}`, or a list of names."""
    units: Mapping[str, str]
    """Units of these quantities, e.g. {"q": "deg"}."""
    topic: str
    """Topic of a bag, group of an HDF5 file, or sheet of a workbook."""
    delimiter: str
    """Delimiter of a CSV file."""
    column_names: Sequence[str]
    """Names of all columns of text without a header."""
    dt: float
    """Time step of files without times, s."""
    poses: bool
    """Whether every row is a held pose."""
    cutoff: float
    """Cutoff of the low-pass filter, Hz."""
    filtering: str
    """When to filter: `derived`, `always` or `never`."""
    form: str
    """Filter type: `acausal` or `causal`."""
    rate: float
    """Rate of the samples, Hz."""
    gap: float
    """Min length of a gap, in median time steps."""
    trim: float
    """Time to cut off at both ends of every part, s."""


def query_of(reading: Reading) -> dict[str, str]:
    """Return the query parameters of the options."""
    return {name: _text(value) for name, value in reading.items() if value is not None}


def _text(value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return json.dumps({name: each if isinstance(each, str) else list(each) for name, each in value.items()})
    if isinstance(value, Sequence):
        return ",".join(map(str, value))
    return str(value)

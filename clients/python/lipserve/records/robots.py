"""Robots. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Literal

from lipserve.records import Record


class RobotJoint(Record, frozen=True, kw_only=True):
    """A movable joint."""

    name: str
    type: Literal["revolute", "prismatic"]


class Robot(Record, frozen=True, kw_only=True):
    """An uploaded, immutable URDF.

    sha256: Hash of the URDF
    joints: Movable joints. Joints that the data do not name are locked
    """

    id: str
    name: str
    created_at: str
    sha256: str
    joints: list[RobotJoint]


class ProfileJoint(Record, frozen=True, kw_only=True):
    """A joint and its limits. A limit is null if the joint has none or it is unknown.

    aliases: Other names of the joint in recordings
    turns_freely: Whether the joint turns endlessly, so that it has no range
    lower: Lower position limit, rad (prismatic: m)
    upper: Upper position limit, rad (prismatic: m)
    max_speed: Speed limit, rad/s (m/s)
    max_acceleration: Acceleration limit, rad/s² (m/s²)
    max_torque: Torque limit, N·m (N)
    torque_constant: Torque constant of the motor current, N·m/A
    """

    name: str
    type: Literal["revolute", "prismatic"]
    aliases: list[str]
    turns_freely: bool
    lower: float | None
    upper: float | None
    max_speed: float | None
    max_acceleration: float | None
    max_torque: float | None
    torque_constant: float | None


class RobotProfile(Record, frozen=True, kw_only=True):
    """A known robot. Its data are read, checked and reported with this profile.

    joints: From base to tip
    effort: Meaning of the effort in recordings, unless the upload says otherwise: measured torque with gravity,
        commanded torque on top of gravity compensation, or motor current in A
    source: Source of the numbers
    urdf_available: Whether jobs with rigid bodies can use this robot by name
    urdf_note: Why no URDF is available; null if one is
    """

    name: str
    title: str
    joints: list[ProfileJoint]
    effort: Literal["measured", "commanded", "current", "unknown"]
    effort_note: str
    source: str
    urdf_available: bool
    urdf_note: str | None

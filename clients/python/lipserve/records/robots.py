"""Robots. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Literal

from lipserve.records import Record


class RobotJoint(Record, frozen=True, kw_only=True):
    """A joint that moves on its own."""

    name: str
    type: Literal["revolute", "prismatic"]


class Robot(Record, frozen=True, kw_only=True):
    """An uploaded URDF, immutable.

    sha256: Hash of the URDF
    joints: Joints that move; those that the data do not name are locked
    """

    id: str
    name: str
    created_at: str
    sha256: str
    joints: list[RobotJoint]


class ProfileJoint(Record, frozen=True, kw_only=True):
    """A joint and its limits; null where it has none, or where none is known.

    aliases: Other names that recordings have for it
    turns_freely: Whether it turns without end, so that it has no range
    lower: rad, or m where it is prismatic
    upper: rad, or m where it is prismatic
    max_speed: rad/s or m/s
    max_acceleration: rad/s² or m/s²
    max_torque: N·m or N
    torque_constant: N·m/A, of its motor current
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
    """What is known of a robot: what data of it are read, checked and reported with.

    joints: From base to tip
    effort: What the effort field of its recordings is, unless the upload says: measured torque, gravity included;
        commanded torque, added to gravity compensation; motor current, A
    source: Of the numbers
    urdf_available: Whether its name will do as the robot of a job with rigid bodies
    urdf_note: Why not
    """

    name: str
    title: str
    joints: list[ProfileJoint]
    effort: Literal["measured", "commanded", "current", "unknown"]
    effort_note: str
    source: str
    urdf_available: bool
    urdf_note: str | None

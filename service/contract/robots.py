"""Uploaded robots and known robot profiles."""

from __future__ import annotations

from pydantic import BaseModel, Field

from lipcore.vocabulary import EffortMeaning, JointType
from service.foundation.fields import BINARY, upload_body


class RobotJoint(BaseModel):
    """A movable joint."""

    name: str
    type: JointType


class Robot(BaseModel):
    """An uploaded, immutable URDF."""

    id: str
    name: str
    created_at: str
    sha256: str = Field(description="Hash of the URDF")
    joints: list[RobotJoint] = Field(description="Movable joints. Joints that the data do not name are locked")


class RobotPage(BaseModel):
    """One page of uploaded robots, newest first."""

    items: list[Robot]
    next_cursor: str | None


class ProfileJoint(RobotJoint):
    """A joint and its limits. A limit is null if the joint has none or it is unknown."""

    aliases: list[str] = Field(description="Other names of the joint in recordings")
    turns_freely: bool = Field(description="Whether the joint turns endlessly, so that it has no range")
    lower: float | None = Field(description="Lower position limit, rad (prismatic: m)")
    upper: float | None = Field(description="Upper position limit, rad (prismatic: m)")
    max_speed: float | None = Field(description="Speed limit, rad/s (m/s)")
    max_acceleration: float | None = Field(description="Acceleration limit, rad/s² (m/s²)")
    max_torque: float | None = Field(description="Torque limit, N·m (N)")
    torque_constant: float | None = Field(description="Torque constant of the motor current, N·m/A")


class RobotProfile(BaseModel):
    """A known robot. Its data are read, checked and reported with this profile."""

    name: str
    title: str
    joints: list[ProfileJoint] = Field(description="From base to tip")
    effort: EffortMeaning = Field(
        description="Meaning of the effort in recordings, unless the upload says otherwise: measured torque with "
        "gravity, commanded torque on top of gravity compensation, or motor current in A"
    )
    effort_note: str
    source: str = Field(description="Source of the numbers")
    urdf_available: bool = Field(description="Whether jobs with rigid bodies can use this robot by name")
    urdf_note: str | None = Field(description="Why no URDF is available; null if one is")


class ProfileList(BaseModel):
    """All known robots, on one page."""

    items: list[RobotProfile] = Field(description="Known robots. Some need the package example-robot-data")
    next_cursor: str | None = None


UPLOAD_BODY = upload_body(
    "A robot with a fixed base: a URDF, a xacro, an SDF, MuJoCo's MJCF, or the zip of a folder with one of them and "
    "the files that it includes. Meshes are not needed. Joints are matched to the data by name.",
    {
        "application/xml": {
            "schema": {"type": "string"},
            "example": '<robot name="arm"><link name="base"/><link name="tip"><inertial><mass value="1"/>'
            '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>'
            '<joint name="joint1" type="continuous"><parent link="base"/><child link="tip"/>'
            '<axis xyz="0 1 0"/></joint></robot>',
        },
        "text/xml": {"schema": {"type": "string"}},
        "application/zip": {"schema": BINARY},
    },
    "A .urdf, .xacro, .sdf, .xml or .zip file",
)

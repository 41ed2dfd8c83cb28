"""Robots as the API shows them."""

from __future__ import annotations

from pydantic import BaseModel, Field

from lipcore.vocabulary import EffortMeaning, JointType
from service.foundation.fields import upload_body


class RobotJoint(BaseModel):
    """A joint that moves on its own."""

    name: str
    type: JointType


class Robot(BaseModel):
    """An uploaded URDF, immutable."""

    id: str
    name: str
    created_at: str
    sha256: str = Field(description="Hash of the URDF")
    joints: list[RobotJoint] = Field(description="Joints that move; those that the data do not name are locked")


class RobotPage(BaseModel):
    """One page of uploaded robots, newest first."""

    items: list[Robot]
    next_cursor: str | None


class ProfileJoint(RobotJoint):
    """A joint and its limits; null where it has none, or where none is known."""

    aliases: list[str] = Field(description="Other names that recordings have for it")
    turns_freely: bool = Field(description="Whether it turns without end, so that it has no range")
    lower: float | None = Field(description="rad, or m where it is prismatic")
    upper: float | None = Field(description="rad, or m where it is prismatic")
    max_speed: float | None = Field(description="rad/s or m/s")
    max_acceleration: float | None = Field(description="rad/s² or m/s²")
    max_torque: float | None = Field(description="N·m or N")
    torque_constant: float | None = Field(description="N·m/A, of its motor current")


class RobotProfile(BaseModel):
    """What is known of a robot: what data of it are read, checked and reported with."""

    name: str
    title: str
    joints: list[ProfileJoint] = Field(description="From base to tip")
    effort: EffortMeaning = Field(
        description="What the effort field of its recordings is, unless the upload says: measured torque, gravity "
        "included; commanded torque, added to gravity compensation; motor current, A"
    )
    effort_note: str
    source: str = Field(description="Of the numbers")
    urdf_available: bool = Field(description="Whether its name will do as the robot of a job with rigid bodies")
    urdf_note: str | None = Field(description="Why not")


class ProfileList(BaseModel):
    """Robots known by name, all on one page."""

    items: list[RobotProfile] = Field(description="Some are known only where example-robot-data is installed")
    next_cursor: str | None = None


UPLOAD_BODY = upload_body(
    "A URDF with a fixed base. Meshes are not needed. Joints are matched to the data by name.",
    {
        "application/xml": {
            "schema": {"type": "string"},
            "example": '<robot name="arm"><link name="base"/><link name="tip"><inertial><mass value="1"/>'
            '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>'
            '<joint name="joint1" type="continuous"><parent link="base"/><child link="tip"/>'
            '<axis xyz="0 1 0"/></joint></robot>',
        },
        "text/xml": {"schema": {"type": "string"}},
    },
    "A .urdf file",
)

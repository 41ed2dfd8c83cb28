"""Robots as the API shows them."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, Field

from lipcore.motion import JointType


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


class ProfileList(BaseModel):
    """Robots known by name, all on one page."""

    items: list[str] = Field(description="Names; empty where example-robot-data is not installed")
    next_cursor: str | None = None


UPLOAD_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "A URDF with a fixed base. Meshes are not needed. Joints are matched to the data by name.",
        "content": {
            "application/xml": {
                "schema": {"type": "string"},
                "example": '<robot name="arm"><link name="base"/><link name="tip"><inertial><mass value="1"/>'
                '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>'
                '<joint name="joint1" type="continuous"><parent link="base"/><child link="tip"/>'
                '<axis xyz="0 1 0"/></joint></robot>',
            },
            "text/xml": {"schema": {"type": "string"}},
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "properties": {"file": {"type": "string", "format": "binary", "description": "A .urdf file"}},
                }
            },
        },
    }
}

"""Gravity and external wrench: requests and answers."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from service.contract.payload import Payload
from service.contract.predictions import MinRevision, Vectors, VersionChoice


class GravityRequest(VersionChoice):
    """Positions at which gravity is wanted, in SI units."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"q": [0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.7]}]},
    )

    q: Vectors = Field(description="Positions, rad (prismatic: m): (n) or (N, n)")
    min_revision: MinRevision = None
    payload: Payload | None = Field(None, description="Payload on the last link, as in `predict`")


class GravityResponse(BaseModel):
    """Torques that hold the arm against gravity, in the shape of the query, without friction and its offset."""

    model: str
    version: int
    revision: int = Field(description="Online updates applied to the version")
    joint_names: list[str]
    mean: list[float] | list[list[float]] = Field(description="Mean, N·m (prismatic: N)")
    std: list[float] | list[list[float]] = Field(description="Standard deviation of the function")


class WrenchRequest(VersionChoice):
    """Motions and measured torques, in SI units."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "q": [0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.7],
                    "dq": [0.1, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0],
                    "ddq": [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
                    "tau": [0.5, -30.0, 1.0, 20.0, 1.0, 2.0, 0.1],
                }
            ]
        },
    )

    q: Vectors = Field(description="Positions, rad (prismatic: m): (n) or (N, n)")
    dq: Vectors = Field(description="Velocities, rad/s (m/s)")
    ddq: Vectors = Field(description="Accelerations, rad/s² (m/s²)")
    tau: Vectors = Field(description="Measured torque, N·m (prismatic: N)")
    tool: Vectors | None = Field(
        None,
        description="Pose of the tool's frame in the last link's, a 4 × 4 matrix, m. By default the last link's frame",
    )
    min_revision: MinRevision = None
    payload: Payload | None = Field(None, description="Payload on the last link, as in `predict`")


class WrenchResponse(BaseModel):
    """Force, N, and moment about the origin of the last link or tool, N·m, that act on the arm.

    It is not a safety function.
    """

    model: str
    version: int
    revision: int = Field(description="Online updates applied to the version")
    joint_names: list[str]
    link: list[float] | list[list[float]] = Field(
        description="Force, then moment, (6) or (N, 6), in the axes of the last link or tool"
    )
    link_covariance: list[list[float]] | list[list[list[float]]] = Field(description="Covariance of `link`, (6, 6)")
    base: list[float] | list[list[float]] = Field(description="The same in the axes of the base")
    base_covariance: list[list[float]] | list[list[list[float]]] = Field(description="Covariance of `base`, (6, 6)")

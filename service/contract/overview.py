"""Short summaries of models for lists."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field

from lipcore.vocabulary import JointType
from service.contract.learning import Alarm, Nullable
from service.contract.payload import LivePayload
from service.contract.verdict import Verdict

Three = list[float]


class SketchedJoint(BaseModel):
    """A joint of a learnt arm, in the frame of the joint before it."""

    joint: int = Field(description="Index of the joint in the model, from 0")
    type: JointType
    rotation: list[Three] = Field(description="Rotation of the joint frame at position zero, 3 × 3")
    translation: Three = Field(description="Translation of the joint frame, m")
    axis: Three = Field(description="Joint axis in the joint frame")
    root: bool = Field(description="Whether the joint is the first of an arm, with its frame in that of the base")
    mass: float = Field(description="Mass of the link that the joint moves, kg")
    centre: Three = Field(description="Centre of mass of this link in the joint frame, m")


class ArmSketch(BaseModel):
    """Geometry for a drawing of an arm, joints from base to tip. The version's `parameters` have the full geometry."""

    gravity: Three
    joints: list[SketchedJoint]


class CoursePoint(BaseModel):
    """Rows of a short time span, each predicted before it was learnt."""

    at: float = Field(description="Start of the time span, Unix seconds")
    rows: int = Field(description="Rows that could be predicted")
    innovation: list[float] = Field(
        description="Per joint, root mean square of (tau - mean) / sqrt(std² + noise_std²): 1 if errors are as large "
        "as predicted"
    )


class RecentQuality(BaseModel):
    """Prediction quality on recent observations."""

    seconds: float = Field(description="Length of the window, s")
    rows: int
    nmse: Nullable = Field(description="Mean squared error / variance of the measured torque")
    coverage: Nullable = Field(description="Share of measurements inside the 95 % interval, noise included")
    course: list[CoursePoint] = Field(description="Time spans, oldest first; time spans without rows are left out")


class ModelOverview(BaseModel):
    """A short summary of a model."""

    name: str
    serving_version: int | None = Field(description="Serving version; null if all versions are candidates")
    latest_version: int
    estimator: str = Field(
        description="Estimator of the serving version, else of the newest. The following fields are of this version"
    )
    created_at: str = Field(description="Creation time of the version")
    joint_names: list[str]
    joint_types: list[JointType]
    verdict: Verdict
    candidate: int | None = Field(description="Version under the alias `candidate`")
    arm: ArmSketch | None = Field(description="Null if the estimator has no arm geometry")
    position: list[float] = Field(
        description="Position at the last row that this process received, rad (m); else a posture of its training"
    )
    idle_s: float | None = Field(description="Time since the last observation, s; null if there was none")
    lag_s: float | None = Field(
        description="Time since the arrival of the first row that responses do not contain yet, s; null if the model "
        "is not in memory"
    )
    recent: RecentQuality | None = Field(
        description="From the quality window nearest to one hour; null if this process has no observations"
    )
    payloads: list[LivePayload] | None = Field(
        description="Payload of each stream; null if the model has no arm geometry or is not in memory"
    )
    held: bool = Field(description="Whether learning is paused until a person decides")
    failure: str | None = Field(description="Why learning fails; null if it does not")
    alarm: Alarm | None = Field(description="Newest alarm")


class OverviewPage(BaseModel):
    """One page of model summaries, newest first."""

    items: list[ModelOverview]
    next_cursor: str | None
    live_after_s: Literal[10] = Field(10, description="A model counts as live if its `idle_s` is below this")

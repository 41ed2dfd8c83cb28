"""Models at a glance, as the API shows them: what a list of robots needs to know of each."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field

from lipcore.vocabulary import JointType
from service.contract.learning import Alarm, Nullable
from service.contract.models import HeldOutQuality
from service.contract.payload import LivePayload

Three = list[float]


class SketchedJoint(BaseModel):
    """A joint of a learnt arm, in the frame of the joint before it."""

    joint: int = Field(description="Which of the model's joints it is, from 0")
    type: JointType
    rotation: list[Three] = Field(description="Of its frame with its position at zero, 3 × 3")
    translation: Three = Field(description="m")
    axis: Three = Field(description="In its own frame")
    mass: float = Field(description="Of what it moves, itself, kg")
    centre: Three = Field(description="Of that mass, in its own frame, m")


class ArmSketch(BaseModel):
    """Enough of an arm to draw it, joints from base to tip; `parameters` of its version has all, with uncertainty."""

    gravity: Three
    joints: list[SketchedJoint]


class CoursePoint(BaseModel):
    """Rows of a short while, each predicted before it was learnt."""

    at: float = Field(description="When that while began, Unix seconds")
    rows: int = Field(description="Rows that could be predicted")
    innovation: list[float] = Field(
        description="Per joint, root mean square of (tau - mean) in standard deviations of a measurement, "
        "sqrt(std² + noise_std²): 1 where errors are as large as the model says"
    )


class RecentQuality(BaseModel):
    """How well a model predicted what it observed lately."""

    seconds: float = Field(description="How far it looks back")
    rows: int
    nmse: Nullable = Field(description="Mean squared error / variance of the measured torque")
    coverage: Nullable = Field(description="Share of measurements inside the 95 % interval, noise included")
    course: list[CoursePoint] = Field(description="Oldest first; a while without rows is left out")


class ModelOverview(BaseModel):
    """A model at a glance."""

    name: str
    serving_version: int | None = Field(description="null where all versions wait as candidates")
    latest_version: int
    estimator: str = Field(description="Of the version that serves, else of the newest, as all that follows")
    created_at: str = Field(description="When that version was made")
    joint_names: list[str]
    joint_types: list[JointType]
    quality: HeldOutQuality | None = Field(description="On what its training held out; null where that was nothing")
    candidate: int | None = Field(description="A version that waits under the alias `candidate`")
    arm: ArmSketch | None = Field(description="null: the estimator knows no arm")
    position: list[float] = Field(
        description="Where it was at the last row that this service took, rad (m); else a posture it was trained at"
    )
    idle_s: float | None = Field(description="Seconds since observations came last; null: never")
    recent: RecentQuality | None = Field(
        description="Of the quality window nearest to an hour; null while nothing that this service knows has come"
    )
    payloads: list[LivePayload] | None = Field(
        description="What each stream's arm carries; null: no arm is known, or the model is not in memory"
    )
    held: bool = Field(description="Whether learning waits for a decision")
    failure: str | None = Field(description="Why the version does not learn, where it should")
    alarm: Alarm | None = Field(description="The newest one")


class OverviewPage(BaseModel):
    """One page of models at a glance, newest first."""

    items: list[ModelOverview]
    next_cursor: str | None
    live_after_s: Literal[10] = Field(10, description="A model whose `idle_s` is below counts as live")

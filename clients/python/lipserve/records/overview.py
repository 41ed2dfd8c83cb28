"""Summaries of models. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Literal

from lipserve.records import Record
from lipserve.records.learning import Alarm
from lipserve.records.live import LivePayload
from lipserve.records.verdicts import Verdict


class SketchedJoint(Record, frozen=True, kw_only=True):
    """A joint of a learnt arm, in the frame of the joint before it.

    joint: Index of the joint in the model, from 0
    rotation: Rotation of the joint frame at position zero, 3 × 3
    translation: Translation of the joint frame, m
    axis: Joint axis in the joint frame
    root: Whether the joint is the first of an arm, with its frame in that of the base
    mass: Mass of the link that the joint moves, kg
    centre: Centre of mass of this link in the joint frame, m
    """

    joint: int
    type: Literal["revolute", "prismatic"]
    rotation: list[list[float]]
    translation: list[float]
    axis: list[float]
    root: bool
    mass: float
    centre: list[float]


class ArmSketch(Record, frozen=True, kw_only=True):
    """Geometry for a drawing of an arm, joints from base to tip. The version's `parameters` have the full geometry."""

    gravity: list[float]
    joints: list[SketchedJoint]


class CoursePoint(Record, frozen=True, kw_only=True):
    """Rows of a short time span, each predicted before it was learnt.

    at: Start of the time span, Unix seconds
    rows: Rows that could be predicted
    innovation: Per joint, root mean square of (tau - mean) / sqrt(std² + noise_std²): 1 if errors are as large as
        predicted
    """

    at: float
    rows: int
    innovation: list[float]


class RecentQuality(Record, frozen=True, kw_only=True):
    """Prediction quality on recent observations.

    seconds: Length of the window, s
    nmse: Mean squared error / variance of the measured torque
    coverage: Share of measurements inside the 95 % interval, noise included
    course: Time spans, oldest first; time spans without rows are left out
    """

    seconds: float
    rows: int
    nmse: list[float | None]
    coverage: list[float | None]
    course: list[CoursePoint]


class ModelOverview(Record, frozen=True, kw_only=True):
    """A short summary of a model.

    serving_version: Serving version; null if all versions are candidates
    estimator: Estimator of the serving version, else of the newest. The following fields are of this version
    created_at: Creation time of the version
    candidate: Version under the alias `candidate`
    arm: Null if the estimator has no arm geometry
    position: Position at the last row that this process received, rad (m); else a posture of its training
    idle_s: Time since the last observation, s; null if there was none
    lag_s: Time since the arrival of the first row that responses do not contain yet, s; null if the model is not in
        memory
    recent: From the quality window nearest to one hour; null if this process has no observations
    payloads: Payload of each stream; null if the model has no arm geometry or is not in memory
    held: Whether learning is paused until a person decides
    failure: Why learning fails; null if it does not
    alarm: Newest alarm
    """

    name: str
    serving_version: int | None
    latest_version: int
    estimator: str
    created_at: str
    joint_names: list[str]
    joint_types: list[Literal["revolute", "prismatic"]]
    verdict: Verdict
    candidate: int | None
    arm: ArmSketch | None
    position: list[float]
    idle_s: float | None
    lag_s: float | None
    recent: RecentQuality | None
    payloads: list[LivePayload] | None
    held: bool
    failure: str | None
    alarm: Alarm | None

"""Models at a glance. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Literal

from lipserve.records import Record
from lipserve.records.learning import Alarm
from lipserve.records.live import LivePayload
from lipserve.records.models import HeldOutQuality


class SketchedJoint(Record, frozen=True, kw_only=True):
    """A joint of a learnt arm, in the frame of the joint before it.

    joint: Which of the model's joints it is, from 0
    rotation: Of its frame with its position at zero, 3 × 3
    translation: m
    axis: In its own frame
    mass: Of what it moves, itself, kg
    centre: Of that mass, in its own frame, m
    """

    joint: int
    type: Literal["revolute", "prismatic"]
    rotation: list[list[float]]
    translation: list[float]
    axis: list[float]
    mass: float
    centre: list[float]


class ArmSketch(Record, frozen=True, kw_only=True):
    """Enough of an arm to draw it, joints from base to tip; `parameters` of its version has all, with uncertainty."""

    gravity: list[float]
    joints: list[SketchedJoint]


class CoursePoint(Record, frozen=True, kw_only=True):
    """Rows of a short while, each predicted before it was learnt.

    at: When that while began, Unix seconds
    rows: Rows that could be predicted
    innovation: Per joint, root mean square of (tau - mean) in standard deviations of a measurement, sqrt(std² +
        noise_std²): 1 where errors are as large as the model says
    """

    at: float
    rows: int
    innovation: list[float]


class RecentQuality(Record, frozen=True, kw_only=True):
    """How well a model predicted what it observed lately.

    seconds: How far it looks back
    nmse: Mean squared error / variance of the measured torque
    coverage: Share of measurements inside the 95 % interval, noise included
    course: Oldest first; a while without rows is left out
    """

    seconds: float
    rows: int
    nmse: list[float | None]
    coverage: list[float | None]
    course: list[CoursePoint]


class ModelOverview(Record, frozen=True, kw_only=True):
    """A model at a glance.

    serving_version: null where all versions wait as candidates
    estimator: Of the version that serves, else of the newest, as all that follows
    created_at: When that version was made
    quality: On what its training held out; null where that was nothing
    candidate: A version that waits under the alias `candidate`
    arm: null: the estimator knows no arm
    position: Where it was at the last row that this service took, rad (m); else a posture it was trained at
    idle_s: Seconds since observations came last; null: never
    recent: Of the quality window nearest to an hour; null while nothing that this service knows has come
    payloads: What each stream's arm carries; null: no arm is known, or the model is not in memory
    held: Whether learning waits for a decision
    failure: Why the version does not learn, where it should
    alarm: The newest one
    """

    name: str
    serving_version: int | None
    latest_version: int
    estimator: str
    created_at: str
    joint_names: list[str]
    joint_types: list[Literal["revolute", "prismatic"]]
    quality: HeldOutQuality | None
    candidate: int | None
    arm: ArmSketch | None
    position: list[float]
    idle_s: float | None
    recent: RecentQuality | None
    payloads: list[LivePayload] | None
    held: bool
    failure: str | None
    alarm: Alarm | None

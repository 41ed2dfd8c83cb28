"""An overview of all models, from the database and from models in memory."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from lipcore.online.window import Window
from service.contract.learning import Alarm
from service.contract.overview import (
    ArmSketch,
    CoursePoint,
    ModelOverview,
    OverviewPage,
    RecentQuality,
    SketchedJoint,
)
from service.learning.control import payload
from service.learning.ingest.monitor import Monitor
from service.learning.learners import Learners
from service.models import registry, verdicts
from service.models.loaded import ServedModel
from service.models.registry import CANDIDATE
from service.storage.database import AlarmRow, EventRow, LearningRow, ModelRow
from service.storage.rows import Page, read_page

HOUR_S = 3600.0
DECIMALS = 3
"""Decimals of the innovations."""
POSTURE_SHARE = 0.3
"""Default position of each joint in the drawing: 0 is the start of its training range, 1 the end."""


def list_models(learners: Learners, part: Page) -> OverviewPage:
    """Return a page of models with their overview, newest first. No model is loaded. Blocking: use it in a thread."""
    now = time.time()
    with learners.database.session() as session:
        rows, following = read_page(session, ModelRow, part)
        names = [row.name for row in rows]
        alarms, seen, held = _alarms(session, names), _read_last_arrivals(session, names), _find_paused(session, names)
    serving = {name: each.version for name, each in registry.serving(learners.database, names).items()}
    pointers = registry.pointers(learners.database, names)
    with learners.database.session() as session:
        versions = registry.rows_of(session, [(row.name, serving.get(row.name, row.last_version)) for row in rows])
    monitors = learners.load_monitors()
    items = []
    for row in rows:
        key = (row.name, serving.get(row.name, row.last_version))
        if (version := versions.get(key)) is None:  # deleted since the first query
            continue
        manifest = version.manifest
        last, served = seen.get(row.name), learners.loaded.peek(row.name)
        items.append(
            ModelOverview(
                name=row.name,
                serving_version=serving.get(row.name),
                latest_version=row.last_version,
                estimator=manifest["estimator"],
                created_at=version.created_at,
                joint_names=manifest["joint_names"],
                joint_types=manifest["joint_types"],
                verdict=verdicts.of_version(manifest, verdicts.options_of(row)),
                candidate=pointers.get((row.name, CANDIDATE)),
                arm=sketch_arm(manifest),
                position=_position(learners, row.name, manifest),
                idle_s=None if last is None else max(now - last, 0.0),
                held=row.name in held,
                failure=learners.status(*key).failure,
                alarm=alarms.get(row.name),
                lag_s=None if served is None else learners.lag(served).seconds,
                **_monitored_fields(monitors.get(row.name), served, now),
            )
        )
    return OverviewPage(items=items, next_cursor=following)


def sketch_arm(manifest: dict[str, Any]) -> ArmSketch | None:
    """Return the learnt arm of a version; None if its estimator learns none. A centre is first moment over mass."""
    parameters = manifest["parameters"]
    if "inertia" not in parameters:
        return None
    geometry, bodies = parameters["geometry"], parameters["inertia"]["bodies"]
    joints = list[SketchedJoint]()
    for joint, at in zip(geometry["order"], geometry["joints"], strict=True):
        body = bodies[joint]["plausible"]
        joints.append(
            SketchedJoint(
                joint=joint,
                root=not joints or at.get("root", False),
                mass=body["mass"],
                centre=[moment / body["mass"] for moment in body["first_moment"]],
                **{name: at[name] for name in ("type", "rotation", "translation", "axis")},
            )
        )
    return ArmSketch(gravity=geometry["gravity"], joints=joints)


def summarise_recent(window: Window, now: float) -> RecentQuality:
    """Return the figures of the window that ends at Unix time `now`, s, and their history."""
    record = window.record(now)
    figures = record.metrics()
    return RecentQuality(
        seconds=window.seconds,
        rows=record.rows,
        nmse=figures["nmse"],
        coverage=figures["coverage"],
        course=[
            CoursePoint(at=at, rows=each.rows, innovation=np.round(np.sqrt(each.standardised), DECIMALS).tolist())
            for at, each in window.course(now)
            if each.rows
        ],
    )


def _monitored_fields(monitor: Monitor | None, served: ServedModel | None, now: float) -> dict[str, Any]:
    """Return the fields that need a monitor of the model."""
    if monitor is None:
        return {"recent": None, "payloads": None}
    window = min(monitor.windows, key=lambda each: abs(each.seconds - HOUR_S))
    return {
        "recent": summarise_recent(window, now),
        "payloads": None if served is None else payload.summarise_payloads(monitor, served),
    }


def _position(learners: Learners, model: str, manifest: dict[str, Any]) -> list[float]:
    """Return the robot's position at its last row.

    If it is unknown, return a posture within the training range that is not stretched out, so that the links are
    visible.
    """
    last = learners.live.positions.get(model)
    if last is not None and len(last) == len(manifest["joint_names"]):
        return last
    span = manifest["training_range"]["q"]
    return [low + POSTURE_SHARE * (high - low) for low, high in zip(span["min"], span["max"], strict=True)]


def _alarms(session: Session, models: Sequence[str]) -> dict[str, Alarm]:
    """Return the newest alarm of each of these models."""
    last = select(func.max(AlarmRow.seq)).where(AlarmRow.model.in_(models)).group_by(AlarmRow.model)
    return {
        row.model: Alarm(id=row.seq, kind=row.kind, at=row.at, message=row.message, evidence=row.evidence)
        for row in session.scalars(select(AlarmRow).where(AlarmRow.seq.in_(last)))
    }


def _read_last_arrivals(session: Session, models: Sequence[str]) -> dict[str, float]:
    """Return when the last observations of each of these models arrived, Unix time, s."""
    last = select(func.max(EventRow.received)).where(EventRow.model == ModelRow.name).scalar_subquery()  # by its index
    query = select(ModelRow.name, last).where(ModelRow.name.in_(models))
    return {model: at for model, at in session.execute(query) if at is not None}


def _find_paused(session: Session, models: Sequence[str]) -> set[str]:
    """Return the models with paused learning."""
    query = select(LearningRow.model, LearningRow.held).where(LearningRow.model.in_(models))
    return {model for model, held in session.execute(query) if held is not None}

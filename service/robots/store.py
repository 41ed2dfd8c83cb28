"""Storing and finding robots, and fitting them to the joints of data."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import undefer

from lipcore.robots import ROBOTS, UnknownRobotError
from lipcore.urdf import MOVABLE, RigidBody, UrdfError, describe
from service.database import Database, JobRow, RobotRow, now
from service.errors import ConflictError, InvalidDataError, not_found, problem
from service.files import new_id
from service.names import LONGEST, for_people
from service.pages import Page, newest
from service.robots.schema import Robot, RobotPage
from service.training.states import ACTIVE


def add(database: Database, content: bytes, name: str | None) -> Robot:
    """Check a URDF and store it; raise InvalidDataError saying what is wrong with it."""
    try:
        urdf = content.decode("utf-8-sig")
        said = describe(urdf)
    except UnicodeDecodeError as error:
        raise _invalid(f"the URDF is not text in UTF-8: {error.reason} at byte {error.start}") from None
    except UrdfError as error:
        raise _invalid(str(error)) from None
    row = RobotRow(
        id=new_id("urdf"),
        name=name or for_people("robot name", said.name[:LONGEST] or "unnamed"),
        created_at=now(),
        sha256=hashlib.sha256(urdf.encode()).hexdigest(),
        joints=[{"name": joint.name, "type": MOVABLE[joint.kind]} for joint in said.joints],
        urdf=urdf,
    )
    with database.transaction() as session:
        session.add(row)
    return _show(row)


def show(database: Database, robot: str) -> Robot:
    """Return one uploaded robot; raise NotFoundError."""
    with database.session() as session:
        row = session.scalar(select(RobotRow).where(RobotRow.id == robot))
    if row is None:
        raise not_found("robot", robot)
    return _show(row)


def page(database: Database, part: Page) -> RobotPage:
    """List uploaded robots, newest first."""
    with database.session() as session:
        rows, following = newest(session, RobotRow, part)
    return RobotPage(items=[_show(row) for row in rows], next_cursor=following)


def delete(database: Database, robot: str) -> None:
    """Delete an uploaded robot; raise ConflictError while a job needs it. Models keep their copy."""
    with database.transaction() as session:
        row = session.scalar(select(RobotRow).where(RobotRow.id == robot))
        if row is None:
            raise not_found("robot", robot)
        for job in session.scalars(select(JobRow).where(JobRow.state.in_(ACTIVE))):
            if job.request.get("robot") == robot:
                raise ConflictError(f"robot {robot!r} is in use by job {job.id!r}: cancel it or wait for its end")
        session.delete(row)


def resolve(database: Database, robot: str, joint_names: Sequence[str], joint_types: Sequence[str]) -> RigidBody:
    """The rigid bodies of a profile or an uploaded URDF for data with these joints.

    Raise UnknownRobotError, JointMismatchError, UrdfError, or SimulationUnavailableError where profiles are missing.
    """
    if robot in ROBOTS:
        return RigidBody.from_profile(robot, joint_names, joint_types)
    with database.session() as session:
        row = session.scalar(select(RobotRow).where(RobotRow.id == robot).options(undefer(RobotRow.urdf)))
    if row is None:
        raise UnknownRobotError(
            f"robot is {robot!r}, expected one of {', '.join(ROBOTS)}, or the id of an uploaded URDF"
        )
    return RigidBody.from_urdf(row.urdf, joint_names, joint_types, name=row.name)


def _invalid(message: str) -> InvalidDataError:
    return InvalidDataError(message, [problem("urdf", message, "a URDF of an arm with a fixed base")])


def _show(row: RobotRow) -> Robot:
    fields = ("id", "name", "created_at", "sha256", "joints")
    return Robot.model_validate({name: getattr(row, name) for name in fields})

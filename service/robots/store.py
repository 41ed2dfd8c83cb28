"""Robot profiles and uploaded URDFs: store and find them, and match them to the joints of data."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from sqlalchemy import select
from sqlalchemy.orm import undefer

from lipcore import profiles
from lipcore.data.motion import Array
from lipcore.profiles import Profile
from lipcore.profiles.names import is_number, split_words
from lipcore.robots.library import ROBOTS, UnknownRobotError, profile_urdf
from lipcore.robots.urdf import RigidBody
from lipcore.robots.urdf_text import MOVABLE, UrdfError
from service.contract.robots import ProfileJoint, Robot, RobotPage, RobotProfile
from service.contract.states import ACTIVE
from service.foundation.errors import (
    ConflictError,
    InvalidRequestError,
    invalid_request,
    not_found,
)
from service.foundation.fields import MAX_NAME_CHARS, check_name
from service.foundation.settings import Settings
from service.robots.caged import ReadUrdf, invalid_urdf
from service.runtime import cage
from service.storage.database import Database, JobRow, RobotRow, now
from service.storage.files import new_id
from service.storage.rows import Page, read_page


def add(
    database: Database, content: bytes, name: str | None, scale: str | None, xacro: str | None, settings: Settings
) -> Robot:
    """Check a robot and store it as URDF in SI units; raise InvalidDataError naming the error in it.

    scale: factors of its quantities, such as `length=0.001,inertia=1e-9`; xacro: arguments, such as `ur_type=ur5e`.
    Raise InvalidRequestError for another text.
    """
    function, factors = "service.robots.caged:read_robot", _factors(scale)
    with TemporaryDirectory(dir=settings.home) as given:
        folder = Path(given)
        upload = folder / "upload"
        upload.write_bytes(content)
        arguments = upload, factors, _pairs("xacro", xacro), folder, settings.max_unpacked_bytes
        read = cage.run(function, ReadUrdf, *arguments, settings=settings, folder=folder, field="urdf")
    urdf, described = read.urdf, read.description
    row = RobotRow(
        id=new_id("urdf"),
        name=name or check_name("robot name", described.name[:MAX_NAME_CHARS] or "unnamed"),
        created_at=now(),
        sha256=hashlib.sha256(urdf.encode()).hexdigest(),
        joints=[{"name": joint.name, "type": MOVABLE[joint.kind]} for joint in described.joints],
        urdf=urdf,
    )
    with database.transaction() as session:
        session.add(row)
    return _show(row)


def _factors(scale: str | None) -> dict[str, float]:
    """Return the factors of a text such as `length=0.001,inertia=1e-9`."""
    try:
        return {quantity: float(factor) for quantity, factor in _pairs("scale", scale).items()}
    except ValueError:
        raise invalid_request("scale", scale, "factors to m, kg and kg·m², such as length=0.001,mass=0.001") from None


def _pairs(field: str, text: str | None) -> dict[str, str]:
    """Return the values by name of a text such as `a=1,b=2`; raise InvalidRequestError."""
    parts = [part.partition("=") for part in ([] if text is None else text.split(","))]
    if not all(name.strip() and equals for name, equals, _ in parts):
        raise invalid_request(field, text, "names with values, such as a=1,b=2")
    return {name.strip(): value.strip() for name, _, value in parts}


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
        rows, following = read_page(session, RobotRow, part)
    return RobotPage(items=[_show(row) for row in rows], next_cursor=following)


def list_profiles() -> list[RobotProfile]:
    """Return all built-in robot profiles."""
    return [_show_profile(profile) for profile in profiles.profiles()]


def show_profile(database: Database, robot: str) -> RobotProfile:
    """Return the profile of a robot by its name or the id of its uploaded URDF; raise NotFoundError."""
    try:
        profile = profile_of(database, robot)
    except InvalidRequestError:
        raise not_found("robot", robot) from None
    return _show_profile(profile)


def delete(database: Database, robot: str) -> None:
    """Delete an uploaded robot; raise ConflictError while a job needs it. Models keep their copy."""
    with database.transaction() as session:
        row = session.scalar(select(RobotRow).where(RobotRow.id == robot))
        if row is None:
            raise not_found("robot", robot)
        for job in session.scalars(select(JobRow).where(JobRow.state.in_(ACTIVE))):
            if job.request.get("robot") == robot:
                raise ConflictError(f"robot {robot!r} is in use by {job.id}: cancel it or wait until it ends")
        session.delete(row)


def resolve(database: Database, robot: str, joint_names: Sequence[str], joint_types: Sequence[str]) -> RigidBody:
    """Return the rigid bodies of a profile or an uploaded URDF, matched to these joints.

    Raise UnknownRobotError, JointMismatchError, UrdfError, or MissingExtraError if profiles are not installed.
    """
    if robot in ROBOTS:
        return _of_profile(robot, joint_names, joint_types)
    if robot in profiles.names():
        raise UrdfError(profiles.profile(robot).explain_missing_urdf())
    row = _find(database, robot)
    if row is None:
        raise UnknownRobotError(
            f"robot is {robot!r}, expected one of {', '.join(ROBOTS)}, or the id of an uploaded URDF"
        )
    names = profiles.from_urdf(row.urdf, row.name).official_names(joint_names)
    alike = names is not None and all(
        split_words(own)[-1:] == split_words(given)[-1:] for own, given in zip(names, joint_names, strict=True)
    )
    if not alike or names == tuple(joint_names):
        return RigidBody.from_urdf(row.urdf, joint_names, joint_types, name=row.name)
    return replace(RigidBody.from_urdf(row.urdf, joint_names, joint_types, names, row.name), matched="name")


def profile_of(database: Database, robot: str) -> Profile:
    """Return the profile of a built-in robot or of an uploaded URDF; raise InvalidRequestError listing all robots."""
    known = profiles.names()
    if robot in known:
        return profiles.profile(robot)
    row = _find(database, robot)
    if row is None:
        raise invalid_request("robot", robot, f"one of {', '.join(known)}, or the id of an uploaded URDF")
    try:
        return profiles.from_urdf(row.urdf, row.name)
    except UrdfError as error:  # an earlier release accepted it
        raise invalid_urdf(f"robot {robot} can no longer be used: {error}") from None


def _of_profile(robot: str, joint_names: Sequence[str], joint_types: Sequence[str]) -> RigidBody:
    urdf = profile_urdf(robot)  # raises an error with the install command if it is missing
    official_names = profiles.profile(robot).official_names(joint_names)
    if official_names is None or (official_names == ROBOTS[robot].free and all(map(is_number, joint_names))):
        return RigidBody.from_profile(robot, joint_names, joint_types)
    # the data have fewer joints or other joint names than the profile: joints without data are locked
    return replace(RigidBody.from_urdf(urdf, joint_names, joint_types, official_names, robot), matched="name")


def _find(database: Database, robot: str) -> RobotRow | None:
    with database.session() as session:
        return session.scalar(select(RobotRow).where(RobotRow.id == robot).options(undefer(RobotRow.urdf)))


def _show(row: RobotRow) -> Robot:
    return Robot.model_validate(row, from_attributes=True)


_NUMBERS = {
    **{"lower": "lower", "upper": "upper", "max_speed": "speed", "max_acceleration": "acceleration"},
    **{"max_torque": "torque", "torque_constant": "torque_constants"},
}
"""Attribute of `Profile` by numeric field of the API."""


def _show_profile(profile: Profile) -> RobotProfile:
    """Return a profile as the API shows it; infinite and unknown values are null."""
    joints = [
        ProfileJoint(
            name=name,
            type=profile.joint_types[joint],
            aliases=list(profile.joint_aliases[joint]),
            turns_freely=bool(math.isinf(profile.lower[joint]) and math.isinf(profile.upper[joint])),
            **{field: _number(getattr(profile, of), joint) for field, of in _NUMBERS.items()},
        )
        for joint, name in enumerate(profile.joint_names)
    ]
    same = {each: getattr(profile, each) for each in ("name", "title", "effort", "effort_note", "source")}
    available = profile.urdf is not None
    note = None if available else profile.explain_missing_urdf()
    return RobotProfile(joints=joints, urdf_available=available, urdf_note=note, **same)


def _number(values: Array | None, joint: int) -> float | None:
    value = math.nan if values is None else float(values[joint])
    return value if math.isfinite(value) else None

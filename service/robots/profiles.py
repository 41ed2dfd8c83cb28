"""Robot profiles as the API shows them."""

from __future__ import annotations

import math

from lipcore import profiles
from lipcore.data.motion import Array
from lipcore.profiles import Profile
from service.foundation.errors import InvalidRequestError, not_found
from service.robots import store
from service.robots.schema import ProfileJoint, RobotProfile
from service.storage.database import Database


def every() -> list[RobotProfile]:
    """Every robot that is known by name."""
    return [shown(profile) for profile in profiles.profiles()]


def show(database: Database, robot: str) -> RobotProfile:
    """The profile of a robot by its name or the id of its uploaded URDF; raise NotFoundError."""
    try:
        profile = store.profile_of(database, robot)
    except InvalidRequestError:
        raise not_found("robot", robot) from None
    return shown(profile)


def shown(profile: Profile) -> RobotProfile:
    """A profile as the API shows it: what is infinite or not known is null."""
    joints = [
        ProfileJoint(
            name=name,
            type=profile.joint_types[joint],
            aliases=list(profile.joint_aliases[joint]),
            turns_freely=bool(math.isinf(profile.lower[joint]) and math.isinf(profile.upper[joint])),
            lower=_number(profile.lower, joint),
            upper=_number(profile.upper, joint),
            max_speed=_number(profile.speed, joint),
            max_acceleration=_number(profile.acceleration, joint),
            max_torque=_number(profile.torque, joint),
            torque_constant=_number(profile.torque_constants, joint),
        )
        for joint, name in enumerate(profile.joint_names)
    ]
    return RobotProfile(
        name=profile.name,
        title=profile.title,
        joints=joints,
        effort=profile.effort,
        effort_note=profile.effort_note,
        source=profile.source,
        urdf_available=profile.urdf is not None,
        urdf_note=None if profile.urdf is not None else profile.why_no_urdf(),
    )


def _number(values: Array | None, joint: int) -> float | None:
    value = math.nan if values is None else float(values[joint])
    return value if math.isfinite(value) else None

"""Reading a URDF where it can do no harm: `service.runtime.cage` calls this in a process of its own."""

from __future__ import annotations

from lipcore.profiles.profile import read_limits
from lipcore.robots.library import pinocchio
from lipcore.robots.urdf import Description, describe
from lipcore.robots.urdf_text import UrdfError
from service.foundation.errors import InvalidDataError, problem


def warm() -> None:
    """Import what reads a URDF; raise MissingExtraError where it is not installed."""
    pinocchio()


def read_urdf(urdf: str) -> Description:
    """What a URDF describes; raise InvalidDataError saying what is wrong with it."""
    try:
        described = describe(urdf)
        read_limits(urdf, described.joint_names)
    except UrdfError as error:
        raise invalid_urdf(str(error)) from None
    return described


def invalid_urdf(message: str) -> InvalidDataError:
    """Error for a URDF that cannot be used."""
    return InvalidDataError(message, [problem("urdf", message, "a URDF of an arm with a fixed base")])

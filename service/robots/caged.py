"""Read a URDF in a separate process, where it can do no harm; called by `service.runtime.cage`."""

from __future__ import annotations

from lipcore.profiles.profile import read_limits
from lipcore.robots.library import pinocchio
from lipcore.robots.urdf import Description, describe
from lipcore.robots.urdf_text import UrdfError
from service.foundation.errors import InvalidDataError, problem


def warm() -> None:
    """Import the URDF reader; raise MissingExtraError if it is not installed."""
    pinocchio()


def read_urdf(urdf: str) -> Description:
    """Return the description of a URDF; raise InvalidDataError naming the error in it."""
    try:
        described = describe(urdf)
        read_limits(urdf, described.joint_names)
    except UrdfError as error:
        raise invalid_urdf(str(error)) from None
    return described


def invalid_urdf(message: str) -> InvalidDataError:
    """Return the error for an unusable URDF."""
    return InvalidDataError(message, [problem("urdf", message, "a URDF of an arm with a fixed base")])

"""Read a URDF in a separate process, where it can do no harm; called by `service.runtime.cage`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import cast

from lipcore.profiles.profile import read_limits
from lipcore.robots import urdf_text, urdf_units
from lipcore.robots.library import pinocchio
from lipcore.robots.mjcf import convert_mjcf, is_mjcf
from lipcore.robots.urdf import Description, describe
from lipcore.robots.urdf_text import UrdfError
from lipcore.robots.urdf_units import Scale
from service.foundation.errors import InvalidDataError, problem


def warm() -> None:
    """Import the URDF reader; raise MissingExtraError if it is not installed."""
    pinocchio()


@dataclass(frozen=True)
class ReadUrdf:
    """A URDF in SI units, and its description."""

    urdf: str
    description: Description


def read_urdf(urdf: str, scale: dict[str, float], folder: Path) -> ReadUrdf:
    """Return a URDF, or an MJCF as URDF, in SI units. scale: factors of its quantities; folder: for temporary files.

    Raise InvalidDataError naming the error in it.
    """
    try:
        if is_mjcf(urdf):
            urdf = convert_mjcf(urdf, folder)
        if scale:
            urdf = urdf_units.scaled(urdf_text.read_urdf(urdf).plain, cast(Scale, scale))
        described = describe(urdf)
        read_limits(urdf, described.joint_names)
    except UrdfError as error:
        raise invalid_urdf(str(error)) from None
    return ReadUrdf(urdf, described)


def invalid_urdf(message: str) -> InvalidDataError:
    """Return the error for an unusable URDF."""
    return InvalidDataError(message, [problem("urdf", message, "a URDF of an arm with a fixed base")])

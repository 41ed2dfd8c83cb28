"""Read a URDF in a separate process, where it can do no harm; called by `service.runtime.cage`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import cast

from lipcore.extras import import_extra
from lipcore.profiles.profile import read_limits
from lipcore.robots import urdf_text, urdf_units
from lipcore.robots.library import pinocchio
from lipcore.robots.mjcf import convert_mjcf, is_mjcf
from lipcore.robots.sdf import convert_sdf, is_sdf
from lipcore.robots.urdf import Description, describe
from lipcore.robots.urdf_text import UrdfError
from lipcore.robots.urdf_units import Scale
from lipcore.robots.xacro_files import expand_xacro, is_xacro, unpack_description
from service.foundation.errors import InvalidDataError, problem


def warm() -> None:
    """Import the URDF reader; raise MissingExtraError if it is not installed."""
    pinocchio()
    import_extra("xacro.substitution_args", "robots")


@dataclass(frozen=True)
class ReadUrdf:
    """A URDF in SI units, and its description."""

    urdf: str
    description: Description


def read_robot(upload: Path, scale: dict[str, float], xacro: dict[str, str], folder: Path, max_bytes: int) -> ReadUrdf:
    """Return a robot as URDF in SI units: a URDF, SDF, MJCF or xacro, or a zip of a folder with one of them.

    scale: factors of its quantities; xacro: arguments; folder: for temporary files; max_bytes: of the files in a zip.
    Raise InvalidDataError naming the error in it.
    """
    try:
        content, files = upload.read_bytes(), folder / "files"
        files.mkdir()
        if content.startswith(b"PK\x03\x04"):
            file = unpack_description(upload, files, max_bytes)
        else:
            file = files / "robot.xacro"
            file.write_bytes(content)
        urdf = _decode(file.read_bytes())
        if is_mjcf(urdf):
            urdf = convert_mjcf(urdf, folder)
        elif is_sdf(urdf):
            urdf = convert_sdf(urdf)
        elif is_xacro(urdf):
            urdf = expand_xacro(file, files, xacro)
        if scale:
            urdf = urdf_units.scaled(urdf_text.read_urdf(urdf).plain, cast(Scale, scale))
        described = describe(urdf)
        read_limits(urdf, described.joint_names)
    except UrdfError as error:
        raise invalid_urdf(str(error)) from None
    return ReadUrdf(urdf, described)


def _decode(content: bytes) -> str:
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UrdfError(f"the URDF is not text in UTF-8: {error.reason} at byte {error.start}") from None


def invalid_urdf(message: str) -> InvalidDataError:
    """Return the error for an unusable URDF."""
    return InvalidDataError(message, [problem("urdf", message, "a URDF of an arm with a fixed base")])

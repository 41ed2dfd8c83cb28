"""What a report needs to know of a robot, in the order of the recording's joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from lipcore.data.samples import Array
from lipcore.vocabulary import JointType


class Profile(Protocol):
    """A robot with n joints; limits (n,), NaN or infinite where unknown. urdf: its text, None where there is none."""

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def joint_names(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def joint_types(self) -> tuple[JointType, ...]: ...  # noqa: D102
    @property
    def lower(self) -> Array: ...  # noqa: D102
    @property
    def upper(self) -> Array: ...  # noqa: D102
    @property
    def speed(self) -> Array: ...  # noqa: D102
    @property
    def torque(self) -> Array: ...  # noqa: D102
    @property
    def urdf(self) -> str | None: ...  # noqa: D102
    def match(self, names: Sequence[str]) -> tuple[int | None, ...]:
        """Which joint each of the names means, None where none."""
        ...


@dataclass(frozen=True)
class Limits:
    """Limits of the recording's n joints, (n,) each, NaN where unknown, as of a joint that is none of the robot's.

    urdf_joints: what the profile calls these joints, None where one is not its; by_order: whether the joints were taken
    in the profile's order, as their names say nothing.
    """

    joint_types: tuple[JointType, ...]
    urdf_joints: tuple[str, ...] | None
    lower: Array
    upper: Array
    speed: Array
    torque: Array
    by_order: bool


def limits_of(profile: Profile | None, names: tuple[str, ...]) -> Limits | None:
    """Limits for a recording with these joints; None without a profile, or where none of its joints is among them."""
    if profile is None:
        return None
    matched = profile.match(names)
    by_order = all(joint is None for joint in matched) and len(names) == len(profile.joint_names)
    if by_order:
        matched = tuple(range(len(names)))
    known = [joint for joint in matched if joint is not None]
    if not known:
        return None
    places = [-1 if joint is None else joint for joint in matched]
    lower, upper, speed, torque = (
        np.append(np.where(np.isfinite(limit), limit, np.nan), np.nan)[places]
        for limit in (profile.lower, profile.upper, profile.speed, profile.torque)
    )
    bounded = upper > lower
    return Limits(
        tuple("revolute" if joint is None else profile.joint_types[joint] for joint in matched),
        tuple(profile.joint_names[joint] for joint in known) if len(known) == len(names) else None,
        np.where(bounded, lower, np.nan),
        np.where(bounded, upper, np.nan),
        np.where(speed > 0, speed, np.nan),
        np.where(torque > 0, torque, np.nan),
        by_order=by_order,
    )

"""Define the limits of a robot's motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.profiles import Profile
from lipcore.vocabulary import JointType


@dataclass(frozen=True)
class Limits:
    """Limits of n joints in SI units, each (n,).

    `lower` and `upper` limit the position, the others magnitudes. An unknown torque limit is infinite. Raise ValueError
    if shapes differ or a range is empty.
    """

    joint_names: tuple[str, ...]
    lower: Array
    upper: Array
    speed: Array
    acceleration: Array
    torque: Array

    def __post_init__(self) -> None:
        n = len(self.joint_names)
        for name in ("lower", "upper", "speed", "acceleration", "torque"):
            values = getattr(self, name)
            if values.shape != (n,):
                raise ValueError(f"{name} has shape {values.shape}, expected {(n,)}, one for each joint")
            finite = np.isfinite(values).all() if name != "torque" else not np.isnan(values).any()
            positive = name not in ("lower", "upper")
            if not finite or (positive and (values <= 0).any()):
                number = "a positive number" if positive else "a finite number"
                raise ValueError(f"{name} is {values.tolist()}, expected {number} for every joint")
        for joint, low, high in zip(self.joint_names, self.lower, self.upper, strict=True):
            if not low < high:
                raise ValueError(f"joint {joint!r} may move from {low} to {high}, expected a range that is not empty")

    @classmethod
    def with_defaults(
        cls,
        joint_names: Sequence[str],
        joint_types: Sequence[JointType],
        lower: Array,
        upper: Array,
        speed: Array,
        acceleration: Array,
        torque: Array,
    ) -> Limits:
        """Return limits of which some are unknown (NaN, infinite or not positive) and replaced by usual ones.

        These are 1 rad/s (0.2 m/s), reached within 0.25 s from rest (the Panda's data sheet allows 0.13 to 0.29 s), and
        half a turn (0.5 m) to either side.
        """
        slides = np.array(joint_types) == "prismatic"
        speed = np.where(_given(speed), speed, np.where(slides, 0.2, 1.0))
        acceleration = np.where(_given(acceleration), acceleration, speed / 0.25)
        span = np.where(slides, 0.5, np.pi)
        lower, upper = np.where(np.isfinite(lower), lower, -span), np.where(np.isfinite(upper), upper, span)
        return cls(tuple(joint_names), lower, upper, speed, acceleration, np.where(_given(torque), torque, np.inf))

    @classmethod
    def of_profile(cls, profile: Profile) -> Limits:
        """Return the limits of a robot's profile, with usual ones if it has none."""
        return cls.with_defaults(
            profile.joint_names,
            profile.joint_types,
            profile.lower,
            profile.upper,
            profile.speed,
            profile.acceleration,
            profile.torque,
        )

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joint_names)

    @property
    def middle(self) -> Array:
        """Return the middle of every joint's range, (n,)."""
        return (self.lower + self.upper) / 2

    @property
    def half(self) -> Array:
        """Return half of every joint's range, (n,)."""
        return (self.upper - self.lower) / 2

    def within(self, position: float = 1.0, motion: float = 1.0, reach: float | None = None) -> Limits:
        """Return a share of these limits: of the range about its middle, and of speed, acceleration and torque.

        reach: max distance from the middle, rad or m. Raise ValueError for shares that are not above 0 and at most 1.
        """
        for name, share in (("position", position), ("motion", motion)):
            if not 0 < share <= 1:
                raise ValueError(f"the share of {name} is {share!r}, expected a number above 0, at most 1")
        if reach is not None and not 0 < reach < np.inf:
            raise ValueError(f"reach is {reach!r}, expected a positive number")
        half = np.minimum(position * self.half, np.inf if reach is None else reach)
        return replace(
            self,
            lower=self.middle - half,
            upper=self.middle + half,
            speed=motion * self.speed,
            acceleration=motion * self.acceleration,
            torque=motion * self.torque,
        )


def _given(values: Array) -> NDArray[np.bool_]:
    return np.isfinite(values) & (np.nan_to_num(values) > 0)

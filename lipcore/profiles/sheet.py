"""How the catalogue writes a robot down, before its URDF is looked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lipcore.data.motion import Array
from lipcore.vocabulary import EffortMeaning

FREE = (-np.inf, np.inf)
"""Range of a joint that turns without end."""


@dataclass(frozen=True)
class Numbers:
    """Limits as a maker publishes them, one a joint, in rad, rad/s, rad/s², N·m; None: not published."""

    ranges: tuple[tuple[float, float], ...]
    speed: tuple[float, ...]
    torque: tuple[float, ...] | None
    acceleration: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Sheet:
    """A robot of the catalogue.

    joints: names as its own URDF or driver has them, from base to tip; aliases: (n) other names, none by default;
    numbers: None takes those of the installed URDF, and without one there is no profile; source: of the numbers;
    placeholders: whether that URDF's limits of speed and torque mean nothing.
    """

    title: str
    joints: tuple[str, ...]
    effort: EffortMeaning
    effort_note: str
    source: str
    numbers: Numbers | None = None
    aliases: tuple[tuple[str, ...], ...] = ()
    placeholders: bool = False


def degrees(*values: float) -> tuple[float, ...]:
    """Degrees in radians."""
    return tuple(np.radians(values).tolist())


def symmetric(*degrees_each: float) -> tuple[tuple[float, float], ...]:
    """Ranges of ± so many degrees, in radians."""
    return tuple((-limit, limit) for limit in degrees(*degrees_each))


def numbered(count: int, *patterns: str) -> tuple[tuple[str, ...], ...]:
    """The names of joints 1..count in each of the patterns."""
    return tuple(tuple(pattern.format(joint) for pattern in patterns) for joint in range(1, count + 1))


def array(values: Sequence[float] | None, n_joints: int) -> Array:
    """Values as an array (n,), NaN where there are none."""
    return np.full(n_joints, np.nan) if values is None else np.array(values, dtype=np.float64)

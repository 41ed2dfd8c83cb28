"""Motions that stand for all that a robot may be asked to do within its limits."""

from __future__ import annotations

import numpy as np

from lipcore.excitation.limits import Limits
from lipcore.excitation.shape import Shape, harmonics
from lipcore.motion import Motion

SPREAD = 1 / 3
"""Standard deviation of speed and acceleration, as a share of their limits."""
SECONDS = 50.0
"""Length of the random motions."""
PER_MOTION = 5
"""Instants that are taken of each of them."""


def draw(limits: Limits, count: int, seed: int) -> Motion:
    """`count` instants of motion: one half from anywhere, the other half from random motions within the limits.

    Anywhere: positions evenly over the range, speeds and accelerations Gaussian and cut off at the limits. That is more
    than tasks ask for: joints seldom are at the ends of their ranges and fast at the same time. Random motions, some
    slow and far, some fast and short, leave corners out that a task may ask for. Against one half alone, plans for both
    did better at what neither half holds.
    """
    rng = np.random.default_rng(seed)
    some = count - count // 2
    q = rng.uniform(limits.lower, limits.upper, (some, limits.n_joints))
    dq, ddq = (
        np.clip(SPREAD * rng.standard_normal(q.shape), -1, 1) * limit for limit in (limits.speed, limits.acceleration)
    )
    shape, parts = Shape.build(limits, SECONDS, harmonics(limits, SECONDS)), [np.stack([q, dq, ddq])]
    while some < count:
        instants = rng.uniform(0, SECONDS, min(PER_MOTION, count - some))
        parts.append(np.stack(shape.series(shape.random(rng)).at(instants)))
        some += len(instants)
    return Motion.from_arrays(*np.concatenate(parts, axis=1))

"""Play elements: friction that remembers where a joint came from.

An element of width r deflects elastically with its joint, and slips when its deflection reaches r (generalised Maxwell
slip). Its deflection e, in units of r, follows the position:

    e ← clip(e + Δq / r, −1, 1)

After a stroke of 2 r in one direction e is ±1, wherever it was before. Until then it lies between two bounds that
follow the same rule and begin at −1 and 1. The expected deflection is their middle. Its standard deviation is half of
their distance: a joint that has stopped may have slipped in either direction.

The velocity v and acceleration a of one instant also tell where the joint comes from. This is used if the motion before
is unknown, or less certain. With the usual acceleration u and A² = a² + (0.1 u)²,

    e = clip(s − a / A, −1, 1),    s = v |v| / (2 A r)

s is the stroke since standstill. Before it the joint moved against its acceleration: a joint that slows down has
slipped already. The standard deviation is exp(−|s| / 2). On recordings of eight real arms, deflections that are known
deviate from this by at most 1.0 times as much for |s| < 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from lipcore.data.motion import Array, Motion
from lipcore.data.samples import Samples
from lipcore.kernels.arrays import constant
from lipcore.kernels.fast.play import CERTAIN_SHARE, POSITIONS, follow

ELEMENTS = (1e-3, 3e-3, 1e-2, 3e-2, 1e-1)
"""Widths of the elements of a revolute joint, rad. All models have the same, so that the deflections of a stream are
functions of its positions alone."""
PRISMATIC_SCALE = 0.1
"""Factor on the widths of a prismatic joint, m/rad: the radius of a pinion."""
MAX_GAP_S = 0.25
"""Time between two samples after which deflections are unknown, s: the joint may have turned back in between."""


def element_widths(joint_types: Sequence[str]) -> Array:
    """Return the widths of the elements, (K, n) rad (m)."""
    scale = np.where(np.array(joint_types) == "prismatic", PRISMATIC_SCALE, 1.0)
    return np.array(ELEMENTS)[:, None] * scale


@dataclass(frozen=True, eq=False)
class PlayState:
    """What is known about the deflections of n joints at one instant, and the instant itself.

    packed: (1 + 2 n + 2 K n,), time, q, dq, and the lower and upper bound of each deflection, element by element.
    """

    packed: Array

    @classmethod
    def unknown(cls, n: int) -> PlayState:
        """Return the state before any motion."""
        return cls(np.concatenate([[-np.inf], np.zeros(2 * n), np.tile([-1.0, 1.0], len(ELEMENTS) * n)]))

    @classmethod
    def at(cls, time: float, q: Array, dq: Array, deflections: Array) -> PlayState:
        """Return the state at one instant. time: s; q, dq: (n,); deflections: (2 K, n), as in `Motion`."""
        expected, std = np.split(deflections, 2)
        bounds = np.stack([expected - std, expected + std], axis=-1)
        return cls(np.concatenate([[time], q, dq, bounds.reshape(-1)]))

    def follow(
        self, time: Array, q: Array, dq: Array, widths: Array, begins: NDArray[np.bool_] | None = None
    ) -> tuple[Array, PlayState]:
        """Return the deflections along N instants, (N, 2 K, n) as in `Motion`, and the state after them.

        The motion before an instant is unknown after a gap, or after a step that its velocities do not explain.
        Instants with a number that is not finite are left out. time: (N,) s; q, dq: (N, n); begins: (N,), instants that
        begin another motion.
        """
        out, packed = np.empty((len(q), 2 * len(widths), q.shape[1])), self.packed.copy()
        begins = np.zeros(len(q), np.bool_) if begins is None else begins
        time, q, dq = (np.ascontiguousarray(each, np.float64) for each in (time, q, dq))
        follow(time, q, dq, begins, widths, MAX_GAP_S, packed, out)
        return out, PlayState(packed)


class PlayFollower:
    """Follows one motion instant by instant, in microseconds.

    motion: (3 + 2 K, n), see `Motion.arrays`; the caller writes q, dq and ddq of the next instant into its first rows.
    """

    def __init__(self, widths: Array) -> None:
        elements, n = widths.shape
        self._widths, self._state = widths, PlayState.unknown(n).packed
        self._begins, self._time = np.zeros(1, np.bool_), np.empty(1)
        self.motion: Array = np.zeros((POSITIONS + 2 * elements, n))
        self._views = self.motion[:1], self.motion[1:2], self.motion[None, POSITIONS:]

    def step(self, time: float) -> None:
        """Write the deflections of the instant into `motion`. time: s."""
        q, dq, out = self._views
        self._time[0] = time
        follow(self._time, q, dq, self._begins, self._widths, MAX_GAP_S, self._state, out)


def with_deflections(samples: Samples, joint_types: Sequence[str]) -> Samples:
    """Return samples with their deflections. Rows are in order of time within an episode; each begins unknown."""
    begins = np.concatenate([[True], np.diff(samples.episode) != 0])[: len(samples)]
    state = PlayState.unknown(samples.n_joints)
    deflections, _ = state.follow(samples.t, samples.q, samples.dq, element_widths(joint_types), begins)
    return replace(samples, deflections=deflections)


def deflections_of(motion: Motion, widths: Array, acceleration: Array) -> Array:
    """Return the deflections of N instants, (N, 2 K, n): those of the motion before, or of the instant if more certain.

    widths: (K, n); acceleration: usual one, (n,). The arrays of the motion are of any library.
    """
    alone = deflections_at(motion.dq, motion.ddq, widths, acceleration)
    if motion.deflections is None:
        return alone
    xp, certain = array_namespace(alone), motion.deflections[:, len(widths) :] <= alone[:, len(widths) :]
    return xp.where(xp.concat([certain, certain], axis=1), motion.deflections, alone)


def deflections_at(dq: Array, ddq: Array, widths: Array, acceleration: Array) -> Array:
    """Return the deflections of N instants alone, (N, 2 K, n) as in `Motion`.

    dq, ddq: (N, n), of any library; widths: (K, n); acceleration: usual one, (n,).
    """
    xp = array_namespace(dq)
    size = xp.sqrt(ddq * ddq + constant(np.square(CERTAIN_SHARE * acceleration), dq))
    stroke = (dq * xp.abs(dq) / (2 * size))[:, None] / constant(widths, dq)
    expected = xp.clip(stroke - (ddq / size)[:, None], -1.0, 1.0)
    return xp.concat([expected, xp.exp(-xp.abs(stroke) / 2)], axis=1)

"""Deflections of play elements, see `kernels.drive.play`: followed along a motion, or given a velocity alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.fast.compile import compiled, inlined

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

POSITIONS = 3
"""Rows of a motion before its deflections: q, dq and ddq."""


@compiled
def follow(q: Array, fresh: Flags, widths: Array, bounds: Array, last: Array, out: Array) -> None:
    """Write the deflections along N instants, (N, 2 K, n), and update the state in place.

    q: (N, n); fresh: (N,), instants whose motion before is unknown; widths: (K, n); bounds: (2, K, n), the range of
    each deflection before the first instant; last: (n,), position then.
    """
    elements, n = widths.shape
    for row in range(q.shape[0]):
        for k in range(elements):
            for j in range(n):
                if fresh[row]:
                    bounds[0, k, j], bounds[1, k, j] = -1.0, 1.0
                else:
                    step = (q[row, j] - last[j]) / widths[k, j]
                    bounds[0, k, j] = min(max(bounds[0, k, j] + step, -1.0), 1.0)
                    bounds[1, k, j] = min(max(bounds[1, k, j] + step, -1.0), 1.0)
                out[row, k, j] = 0.5 * (bounds[0, k, j] + bounds[1, k, j])
                out[row, elements + k, j] = 0.5 * (bounds[1, k, j] - bounds[0, k, j])
        last[:] = q[row]


@inlined
def known_share(velocity: float, width: float, acceleration: float) -> float:
    """Return the share of an element's range that the stroke since standstill has excluded, 0 to 1."""
    return min(velocity * velocity / (4.0 * acceleration * width), 1.0)


@inlined
def expected_deflection(motion: Array, joint: int, k: int, elements: Array) -> float:
    """Return the expected deflection of an element. elements: (K + 1, n), widths and usual acceleration."""
    if motion.shape[0] > POSITIONS:
        return motion[POSITIONS + k, joint]
    velocity, last = motion[1, joint], elements.shape[0] - 1
    share = known_share(velocity, elements[k, joint], elements[last, joint])
    return share if velocity > 0.0 else -share


@inlined
def half_range(motion: Array, joint: int, k: int, count: int, width: float, acceleration: float) -> float:
    """Return the half width of the range of an element's deflection, 0 to 1. count: number of elements."""
    if motion.shape[0] > POSITIONS:
        return motion[POSITIONS + count + k, joint]
    return 1.0 - known_share(motion[1, joint], width, acceleration)

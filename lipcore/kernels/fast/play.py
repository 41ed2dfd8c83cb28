"""Deflections of play elements, see `kernels.drive.play`: followed along a motion, or given one instant of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.fast.compile import compiled, inlined

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

CERTAIN_SHARE = 0.1
"""Acceleration, as a share of the usual one, above which its direction tells which way a joint turns."""
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
def expected_deflection(motion: Array, joint: int, k: int, elements: Array) -> float:
    """Return the expected deflection of an element. elements: (K + 1, n), widths and usual acceleration."""
    if motion.shape[0] > POSITIONS:
        return motion[POSITIONS + k, joint]
    velocity, pushed = motion[1, joint], motion[2, joint]
    size = np.hypot(pushed, CERTAIN_SHARE * elements[elements.shape[0] - 1, joint])
    stroke = 0.5 * velocity * abs(velocity) / (size * elements[k, joint])
    return min(max(stroke - pushed / size, -1.0), 1.0)


@inlined
def deflection_std(motion: Array, joint: int, k: int, count: int, width: float, acceleration: float) -> float:
    """Return the standard deviation of an element's deflection, 0 to 1. count: number of elements."""
    if motion.shape[0] > POSITIONS:
        return motion[POSITIONS + count + k, joint]
    size = np.hypot(motion[2, joint], CERTAIN_SHARE * acceleration)
    return np.exp(-0.25 * motion[1, joint] ** 2 / (size * width))

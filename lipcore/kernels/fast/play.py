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
def follow(
    time: Array, q: Array, dq: Array, begins: Flags, widths: Array, max_gap: float, state: Array, out: Array
) -> None:
    """Write the deflections along N instants, (N, 2 K, n), and update the state in place, see `PlayState`.

    time: (N,) s; q, dq: (N, n); begins: (N,), instants whose motion before is unknown; widths: (K, n); max_gap: s;
    state: (1 + 2 n + 2 K n,), time, q and dq of the instant before, and the bounds of the deflections then. Instants
    that are not finite do not change the state.
    """
    elements, n = widths.shape
    bounds = 1 + 2 * n
    for row in range(len(time)):
        elapsed = time[row] - state[0]
        fresh, finite = begins[row] or not 0.0 <= elapsed <= max_gap, np.isfinite(time[row])
        for j in range(n):
            finite = finite and np.isfinite(q[row, j]) and np.isfinite(dq[row, j])
            if not fresh:
                expected = 0.5 * (dq[row, j] + state[1 + n + j]) * elapsed
                fresh = not abs(q[row, j] - state[1 + j] - expected) <= widths[elements - 1, j]
        for k in range(elements):
            for j in range(n):
                low, high = -1.0, 1.0
                at = bounds + 2 * (n * k + j)
                if finite and not fresh:
                    step = (q[row, j] - state[1 + j]) / widths[k, j]
                    low = min(max(state[at] + step, -1.0), 1.0)
                    high = min(max(state[at + 1] + step, -1.0), 1.0)
                if finite:
                    state[at], state[at + 1] = low, high
                out[row, k, j] = 0.5 * (low + high)
                out[row, elements + k, j] = 0.5 * (high - low)
        if finite:
            state[0] = time[row]
            state[1 : 1 + n] = q[row]
            state[1 + n : bounds] = dq[row]


@inlined
def expected_deflection(motion: Array, joint: int, k: int, elements: Array) -> float:
    """Return the expected deflection of an element. elements: (K + 1, n), widths and usual acceleration.

    It is that of the motion before, unless the instant alone is more certain.
    """
    count, known = elements.shape[0] - 1, motion.shape[0] > POSITIONS
    if known and motion[POSITIONS + count + k, joint] == 0.0:
        return motion[POSITIONS + k, joint]
    velocity, pushed = motion[1, joint], motion[2, joint]
    size = np.hypot(pushed, CERTAIN_SHARE * elements[count, joint])
    stroke = 0.5 * velocity * abs(velocity) / (size * elements[k, joint])
    if known and motion[POSITIONS + count + k, joint] <= np.exp(-0.5 * abs(stroke)):
        return motion[POSITIONS + k, joint]
    return min(max(stroke - pushed / size, -1.0), 1.0)


@inlined
def deflection_std(motion: Array, joint: int, k: int, count: int, width: float, acceleration: float) -> float:
    """Return the standard deviation of an element's deflection, 0 to 1. count: number of elements."""
    known = motion[POSITIONS + count + k, joint] if motion.shape[0] > POSITIONS else 1.0
    if known == 0.0:
        return 0.0
    size = np.hypot(motion[2, joint], CERTAIN_SHARE * acceleration)
    return min(known, np.exp(-0.25 * motion[1, joint] ** 2 / (size * width)))

"""Friction's features of one query, compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.compiled.compile import compiled

Array = NDArray[np.float64]


@compiled
def friction_rows(motion: Array, width: float, out: Array) -> None:
    """Rows 3 j to 3 j + 2 of `out`, (3 n, n): joint j's dq, tanh(dq / width) and 1 in column j, else zero."""
    out[:] = 0.0
    for joint in range(motion.shape[1]):
        velocity = motion[1, joint]
        out[3 * joint, joint] = velocity
        out[3 * joint + 1, joint] = np.tanh(velocity / width)
        out[3 * joint + 2, joint] = 1.0

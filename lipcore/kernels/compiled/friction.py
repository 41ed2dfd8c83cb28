"""Friction's features of one query, compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.compiled.compile import compiled

Array = NDArray[np.float64]


@compiled
def friction_rows(motion: Array, width: float, speed: float, out: Array) -> None:
    """Rows f j to f j + f − 1 of `out`, (f n, n), f = 3 or 4: joint j's dq, s = tanh(dq / width), 1 and, where f = 4,
    s exp(−(dq / speed)²) in column j, else zero."""
    out[:] = 0.0
    terms = out.shape[0] // motion.shape[1]
    for joint in range(motion.shape[1]):
        velocity, first = motion[1, joint], terms * joint
        sign = np.tanh(velocity / width)
        out[first, joint] = velocity
        out[first + 1, joint] = sign
        out[first + 2, joint] = 1.0
        if terms == 4:
            out[first + 3, joint] = sign * np.exp(-((velocity / speed) ** 2))

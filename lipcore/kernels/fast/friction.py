"""Friction features of queries, see `kernels.friction.FrictionKernel`, and ddq with them for the arms of a mixture."""

from __future__ import annotations

import numpy as np

from lipcore.kernels.fast.compile import brief, compiled
from lipcore.kernels.fast.joints import Array


@brief
def friction_query(motion: Array, width: float, speed: float, out: Array) -> None:
    """Write joint j's features into rows f j to f j + f − 1 of `out`, (f n, n), f = 3 or 4.

    They are dq, s = tanh(dq / width), 1 and, if f = 4, s exp(−(dq / speed)²), in column j. All other elements are zero.
    """
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


@compiled
def friction_queries(motions: Array, width: float, speed: float, out: Array, first: int, last: int) -> None:
    """Write the features of N queries, (N, 3, n), into rows `first` to `last` of each part of `out`, (N, …, n)."""
    for k in range(motions.shape[0]):
        friction_query(motions[k], width, speed, out[k, first:last])


@compiled
def linear_features(motions: Array, width: float, speed: float, out: Array) -> None:
    """Write ddq and the friction features of each joint, (N, n, 4 or 5). motions: (N, 3, n)."""
    for k in range(motions.shape[0]):
        for j in range(motions.shape[2]):
            velocity = motions[k, 1, j]
            sign = np.tanh(velocity / width)
            out[k, j, 0], out[k, j, 1], out[k, j, 2], out[k, j, 3] = motions[k, 2, j], velocity, sign, 1.0
            if out.shape[2] > 4:
                out[k, j, 4] = sign * np.exp(-((velocity / speed) ** 2))

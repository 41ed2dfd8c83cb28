"""Terms of the drive for queries, see `kernels.drive.terms`, and ddq with them for the arms of a mixture.

Common arguments:

- kinds: (7,), one for each of `DRIVE_KINDS`: 1 if the drive has it, else 0;
- memory: `Memory` of the arm's constants, gravity and parameters, with `drive_size` elements to work in; without the
  kinds `load` and `gain`, only n elements;
- order: (n,), the data's joint at each place of the chain;
- elements: (K + 1, n), widths of the play elements and the usual acceleration; (1, n) without the kind `play`.
"""

from __future__ import annotations

import numpy as np

from lipcore.kernels.fast.arm_recursion import (
    CONSTANTS,
    PARAMETERS,
    WORK,
    Array,
    Indices,
    bodies,
    kinematics,
    torques,
)
from lipcore.kernels.fast.compile import brief, compiled, inlined
from lipcore.kernels.fast.play import expected_deflection
from lipcore.kernels.fast.views import numbers

STRIBECK, SPEED, SIDES, POSITION, LOAD, GAIN, PLAY = range(7)
"""Places of the kinds."""
HARMONICS = 4
"""Max periods a turn of the kind `position`. On the residuals of five recordings, 5 to 32 periods predicted no held-out
eighth of a joint better."""


def drive_size(n: int) -> int:
    """Return the number of elements that the kinds `load` and `gain` work in."""
    return (n + 1) * WORK + n


@inlined
def _write_terms(
    motion: Array,
    joint: int,
    load: float,
    kinds: Indices,
    constants: Array,
    elements: Array,
    out: Array,
    row: int,
    column: int,
) -> None:
    """Write a joint's terms into a column of `out`, from a row on.

    constants: (5,), speeds of the sign, of `stribeck` and of the three shapes.
    """
    velocity = motion[1, joint]
    sign, speed = np.tanh(velocity / constants[0]), abs(velocity)
    out[row, column] = velocity
    out[row + 1, column] = sign
    out[row + 2, column] = 1.0
    row += 3
    if kinds[STRIBECK]:
        out[row, column] = sign * np.exp(-((velocity / constants[1]) ** 2))
        row += 1
    if kinds[SPEED]:
        for k in range(3):
            out[row + k, column] = np.tanh(velocity / constants[2 + k])
        out[row + 3, column] = velocity * speed
        row += 4
    if kinds[SIDES]:
        out[row, column] = abs(sign)
        out[row + 1, column] = speed
        row += 2
    if kinds[POSITION]:
        sine, cosine = np.sin(motion[0, joint]), np.cos(motion[0, joint])
        out[row, column], out[row + 1, column] = sine, cosine
        for k in range(2, 2 * HARMONICS, 2):  # sin (k + 1) q and cos (k + 1) q from those of k q and q
            before, other = out[row + k - 2, column], out[row + k - 1, column]
            out[row + k, column] = before * cosine + other * sine
            out[row + k + 1, column] = other * cosine - before * sine
        row += 2 * HARMONICS
    if kinds[LOAD]:
        out[row, column] = abs(load) * sign
        out[row + 1, column] = abs(load) * velocity
        row += 2
    if kinds[GAIN]:
        out[row, column] = load
        row += 1
    if kinds[PLAY]:
        for k in range(elements.shape[0] - 1):
            out[row + k, column] = expected_deflection(motion, joint, k, elements)


@compiled
def _write_load(memory: Array, order: Indices, kinds: Indices, motion: Array, load: Array) -> None:
    """Write the torque that the bodies need at each joint, (n,), if a kind needs it."""
    if not (kinds[LOAD] or kinds[GAIN]):
        return
    n = order.shape[0]
    place = n * CONSTANTS
    body = place + 3
    at = body + n * PARAMETERS
    work = numbers(memory, at, (n + 1, WORK))
    kinematics(numbers(memory, 0, (n, CONSTANTS)), memory[place:body], motion, order, work)
    bodies(numbers(memory, 0, (n, CONSTANTS)), numbers(memory, body, (n, PARAMETERS)), work)
    torques(order, work, load)


@brief
def drive_query(
    memory: Array, order: Indices, kinds: Indices, constants: Array, elements: Array, motion: Array, out: Array
) -> None:
    """Write joint j's terms into rows f j to f j + f − 1 of `out`, (f n, n), in column j. Other elements are zero."""
    n = order.shape[0]
    load = memory[memory.shape[0] - n :]
    _write_load(memory, order, kinds, motion, load)
    out[:] = 0.0
    terms = out.shape[0] // n
    for joint in range(n):
        _write_terms(motion, joint, load[joint], kinds, constants, elements, out, terms * joint, joint)


@compiled
def drive_queries(
    memory: Array,
    order: Indices,
    kinds: Indices,
    constants: Array,
    elements: Array,
    motions: Array,
    out: Array,
    first: int,
    last: int,
) -> None:
    """Write the terms of N queries, (N, …, n), into rows `first` to `last` of each part of `out`, (N, …, n)."""
    for k in range(motions.shape[0]):
        drive_query(memory, order, kinds, constants, elements, motions[k], out[k, first:last])


@compiled
def linear_features(
    memory: Array, order: Indices, kinds: Indices, constants: Array, elements: Array, motions: Array, out: Array
) -> None:
    """Write ddq and the terms of each joint, (N, n, 1 + f). motions: (N, …, n)."""
    n = order.shape[0]
    load = memory[memory.shape[0] - n :]
    for k in range(motions.shape[0]):
        _write_load(memory, order, kinds, motions[k], load)
        for j in range(n):
            out[k, j, 0] = motions[k, 2, j]
            _write_terms(motions[k], j, load[j], kinds, constants, elements, out[k].T, 1, j)

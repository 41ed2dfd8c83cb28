"""Motion and forces of serial arms of rigid bodies: recursive Newton–Euler, docs/method.md (14).

Coordinates are those of the world. All spatial vectors are about the base's origin: motions (ω, v), forces (n, f). S_i
is the screw of joint i. V_i and A_i are the velocity and acceleration of body i; gravity is an acceleration of the
base. All bodies from i to the tip of its arm together have mass m, first moment h, inertia Ī, momentum P = (L, p) and
force F:

    τ_i = S_iᵀ F_i                                   F = Σ I A + V ×* I V
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.fast.compile import compiled, inlined

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

PARAMETERS = 10  # per body: mass, first moment (3), inertia xx, xy, yy, xz, yz, zz, about its joint's frame
CONSTANTS = 48  # per joint: three 3×3 matrices of its rotation, its place, its axis, two vectors across it, its type,
# the number of its steps, and the first joint of its arm

# offsets in a joint's row of `constants`
TURN, PLACE, AXIS, ACROSS, KIND, SCREWS, ROOT = 0, 27, 30, 33, 39, 40, 41
# offsets in a joint's row of `work`
R, ORIGIN, S, E, V, A, MASS, H, INERTIA, P, N, F, D, G = 0, 9, 12, 18, 24, 30, 36, 37, 40, 49, 52, 61, 67, 73
WORK = 128
PSI, PSI2, FORCE, SCREW, SPARE = 76, 82, 88, 94, 100


@inlined
def add_cross(a: Array, i: int, b: Array, j: int, out: Array, k: int) -> None:
    """Add a × b to `out`. Each is a 3-vector that starts at the given element."""
    out[k] += a[i + 1] * b[j + 2] - a[i + 2] * b[j + 1]
    out[k + 1] += a[i + 2] * b[j] - a[i] * b[j + 2]
    out[k + 2] += a[i] * b[j + 1] - a[i + 1] * b[j]


@inlined
def moving_cross(a: Array, i: int, b: Array, j: int, out: Array, k: int) -> None:
    """Write a × b of two motions (ω, v)."""
    x, y, z, u, v, w = b[j], b[j + 1], b[j + 2], b[j + 3], b[j + 4], b[j + 5]
    out[k] = a[i + 1] * z - a[i + 2] * y
    out[k + 1] = a[i + 2] * x - a[i] * z
    out[k + 2] = a[i] * y - a[i + 1] * x
    out[k + 3] = a[i + 1] * w - a[i + 2] * v + a[i + 4] * z - a[i + 5] * y
    out[k + 4] = a[i + 2] * u - a[i] * w + a[i + 5] * x - a[i + 3] * z
    out[k + 5] = a[i] * v - a[i + 1] * u + a[i + 3] * y - a[i + 4] * x


@inlined
def add_force_cross(a: Array, i: int, b: Array, j: int, out: Array, k: int) -> None:
    """Add a ×* b of a motion (ω, v) and a force (n, f)."""
    add_cross(a, i, b, j, out, k)
    add_cross(a, i + 3, b, j + 3, out, k)
    add_cross(a, i, b, j + 3, out, k + 3)


@inlined
def dot(a: Array, i: int, b: Array, j: int, size: int) -> float:
    """Return a · b of `size` numbers, which start at the given elements."""
    total = 0.0
    for k in range(size):
        total += a[i + k] * b[j + k]
    return total


@inlined
def momentum(row: Array, motion: Array, i: int, out: Array, k: int) -> None:
    """Write the force I x of a motion x. `row` contains mass, first moment and inertia of the bodies."""
    for c in range(3):
        out[k + c] = dot(row, INERTIA + 3 * c, motion, i, 3)
        out[k + 3 + c] = row[MASS] * motion[i + 3 + c]
    add_cross(row, H, motion, i + 3, out, k)
    add_cross(motion, i, row, H, out, k + 3)


@inlined
def row_before(constants: Array, j: int) -> int:
    """Return the row of `work` of the body before joint j; the base is in the last row."""
    return constants.shape[0] if constants[j, ROOT] == j else j - 1


@inlined
def is_carrying(constants: Array, j: int) -> bool:
    """Return whether joint j + 1 is of the same arm."""
    return j + 1 < constants.shape[0] and constants[j + 1, ROOT] != j + 1


@compiled
def kinematics(constants: Array, gravity: Array, motion: Array, order: Indices, work: Array) -> None:
    """Write R, ORIGIN, S, E, V and A of each joint, base to tip.

    constants: (n, CONSTANTS), see `Geometry.constants`; gravity: (3,) m/s² in the base's frame; motion: (3, n), q, dq
    and ddq in the order of the data; order: (n,), the data's joint at each place of the chain; work: (n + 1, WORK),
    with the base in the last row.
    """
    n = constants.shape[0]
    base = work[n]
    base[: A + 6] = 0.0
    base[R] = base[R + 4] = base[R + 8] = 1.0
    for c in range(3):
        base[A + 3 + c] = -gravity[c]
    for j in range(n):
        fixed, row, before = constants[j], work[j], work[row_before(constants, j)]
        q, dq, ddq = motion[0, order[j]], motion[1, order[j]], motion[2, order[j]]
        revolute = fixed[KIND] == 0.0
        sin, cos = (np.sin(q), np.cos(q)) if revolute else (0.0, 1.0)
        slide = 0.0 if revolute else q
        for r in range(3):
            for c in range(3):
                total = 0.0
                for k in range(3):
                    at = TURN + 3 * k + c
                    total += before[R + 3 * r + k] * (fixed[at] + sin * fixed[at + 9] + cos * fixed[at + 18])
                row[R + 3 * r + c] = total
            row[ORIGIN + r] = before[ORIGIN + r] + dot(before, R + 3 * r, fixed, PLACE, 3)
            row[E + r] = dot(before, R + 3 * r, fixed, ACROSS, 3)
            row[E + 3 + r] = dot(before, R + 3 * r, fixed, ACROSS + 3, 3)
            axis = dot(before, R + 3 * r, fixed, AXIS, 3)
            row[S + r] = axis if revolute else 0.0
            row[S + 3 + r] = 0.0 if revolute else axis
        if revolute:
            add_cross(row, ORIGIN, row, S, row, S + 3)
        moving_cross(before, V, row, S, row, A)
        for c in range(6):
            row[A + c] = before[A + c] + row[S + c] * ddq + row[A + c] * dq
            row[V + c] = before[V + c] + row[S + c] * dq
        row[SPARE] = slide  # the frame's own origin is here; the screws across the axis act at its place at q = 0
        if not revolute:
            for c in range(3):
                row[ORIGIN + c] += slide * row[S + 3 + c]


@compiled
def bodies(constants: Array, parameters: Array, work: Array) -> None:
    """Write MASS, H, INERTIA, P, N and F of each joint after `kinematics`: sums from its body to its arm's tip.

    parameters: (n, 10) of the bodies, base to tip.
    """
    n = constants.shape[0]
    for j in range(n - 1, -1, -1):
        row, body = work[j], parameters[j]
        _place_body(row, body)
        spare = row[PSI:]  # not yet in use
        momentum(row, row, V, spare, 0)
        for c in range(3):
            row[P + c] = spare[3 + c]
        momentum(row, row, A, row, F)
        add_force_cross(row, V, spare, 0, row, F)
        _coriolis(row)
        if is_carrying(constants, j):
            for c in range(MASS, F + 6):
                row[c] += work[j + 1, c]


@compiled
def _place_body(row: Array, body: Array) -> None:
    """Write MASS, H and INERTIA of one body about the base's origin."""
    mass = body[0]
    row[MASS] = mass
    for c in range(3):  # about its own origin first
        row[SPARE + 1 + c] = dot(row, R + 3 * c, body, 1, 3)
        row[H + c] = row[SPARE + 1 + c] + mass * row[ORIGIN + c]
    for r in range(3):
        r0, r1, r2 = row[R + 3 * r], row[R + 3 * r + 1], row[R + 3 * r + 2]
        x = r0 * body[4] + r1 * body[5] + r2 * body[7]
        y = r0 * body[5] + r1 * body[6] + r2 * body[8]
        z = r0 * body[7] + r1 * body[8] + r2 * body[9]
        for c in range(3):
            row[INERTIA + 3 * r + c] = x * row[R + 3 * c] + y * row[R + 3 * c + 1] + z * row[R + 3 * c + 2]
    # Steiner: − h× o× − o× h× − m o× o×, with a× b× = b aᵀ − (a·b) 1
    inner = 2 * dot(row, SPARE + 1, row, ORIGIN, 3) + mass * dot(row, ORIGIN, row, ORIGIN, 3)
    for r in range(3):
        for c in range(3):
            cross = row[SPARE + 1 + r] * row[ORIGIN + c] + row[ORIGIN + r] * row[SPARE + 1 + c]
            row[INERTIA + 3 * r + c] -= cross + mass * row[ORIGIN + r] * row[ORIGIN + c]
        row[INERTIA + 4 * r] += inner


@compiled
def _coriolis(row: Array) -> None:
    """Write N of one body: 2 ω× Ī − tr Ī ω× − 2 h× v×."""
    trace = row[INERTIA] + row[INERTIA + 4] + row[INERTIA + 8]
    column = row[SPARE + 1 : SPARE + 10]
    inner = dot(row, H, row, V + 3, 3)
    for c in range(3):
        for k in range(3):
            column[k] = 2 * row[INERTIA + 3 * k + c]
            column[3 + k] = 0.0
        column[c] -= trace
        add_cross(row, V, column, 0, column, 3)
        for r in range(3):
            row[N + 3 * r + c] = column[3 + r] - 2 * row[V + 3 + r] * row[H + c]
        row[N + 4 * c] += 2 * inner


@compiled
def torques(order: Indices, work: Array, out: Array) -> None:
    """Write τ, (n,) in the order of the data, after `bodies`."""
    for i in range(order.shape[0]):
        out[order[i]] = dot(work[i], S, work[i], F, 6)


@compiled
def sum_momenta(constants: Array, parameters: Array, work: Array) -> None:
    """Write D of each joint, the momentum (L, p) of all bodies from its own to the tip of its arm.

    The sums of masses are preserved.
    """
    n = parameters.shape[0]
    for j in range(n - 1, -1, -1):
        row = work[j]
        kept = row[MASS : INERTIA + 9].copy()
        _place_body(row, parameters[j])
        momentum(row, row, V, row, D)
        row[MASS : INERTIA + 9] = kept
        if is_carrying(constants, j):
            for c in range(6):
                row[D + c] += work[j + 1, D + c]

"""Torque of a serial arm of rigid bodies, its derivatives by masses and by geometry, and its energies: compiled.

World coordinates, all spatial vectors about the base's origin: motions (ω, v), forces (n, f). With S_i the screw of
joint i, V_i and A_i velocity and acceleration of body i (gravity is an acceleration of the base), and for all bodies
from i to the tip together mass m, first moment h, inertia Ī, momentum P = (L, p) and force F:

    τ_i = S_iᵀ F_i                                   F = Σ I A + V ×* I V

If the subtree of joint j is displaced by a screw s that is fixed to the body before it (velocity V, acceleration A),
its bodies see the velocity ψ̇ = V × s and the acceleration ψ̈ = A × s + V × ψ̇ more, and turn the force along with them:

    i < j:   ∂τ_i = S_iᵀ (I_j ψ̈ + 2 B_j ψ̇ + s ×* F_j)          i ≥ j:   ∂τ_i = S_iᵀ (I_i ψ̈ + 2 B_i ψ̇)

with 2 B δ = δ ×* (I V) + V ×* (I δ) − I (V × δ) for a change δ of velocity. (This is ∂τ/∂q of Singh, Russell & Wensing
2022 with any screw in the place of a joint's own.) Written out with Jacobi's identity, only the angular part w of δ is
left, and sums over bodies stay sums:  2 B δ = (N w, 2 w × p),  N = Σ 2 (ω× Ī − ½ tr Ī ω×) − 2 h× v×.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.compiled.compile import compiled
from lipcore.kernels.compiled.views import plane

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

PARAMETERS = 10  # of a body: mass, first moment (3), inertia xx, xy, yy, xz, yz, zz, about its joint's frame
CONSTANTS = 48  # of a joint: three 3×3 matrices of its rotation, its place, two vectors across its axis, all before it

# where things lie in a joint's row of `constants`
TURN, PLACE, AXIS, ACROSS, KIND, SCREWS = 0, 27, 30, 33, 39, 40
# and in its row of `work`
R, ORIGIN, S, E, V, A, MASS, H, INERTIA, P, N, F, D, G = 0, 9, 12, 18, 24, 30, 36, 37, 40, 49, 52, 61, 67, 73
WORK = 128
_PSI, _PSI2, _FORCE, _SCREW, _SPARE = 76, 82, 88, 94, 100
FORCE_OF, MOMENT_OF, AT_LINK = (
    0,
    30,
    60,
)  # of the table that `masses` works in: 3 × 10 each, and what it needs of a body
TABLE = 80


@compiled
def _cross(a: Array, i: int, b: Array, j: int, out: Array, k: int) -> None:
    """Add a × b to `out`; each a 3-vector from the element given on."""
    out[k] += a[i + 1] * b[j + 2] - a[i + 2] * b[j + 1]
    out[k + 1] += a[i + 2] * b[j] - a[i] * b[j + 2]
    out[k + 2] += a[i] * b[j + 1] - a[i + 1] * b[j]


@compiled
def _moving_cross(a: Array, i: int, b: Array, j: int, out: Array, k: int) -> None:
    """Write a × b of two motions (ω, v)."""
    x, y, z, u, v, w = b[j], b[j + 1], b[j + 2], b[j + 3], b[j + 4], b[j + 5]
    out[k] = a[i + 1] * z - a[i + 2] * y
    out[k + 1] = a[i + 2] * x - a[i] * z
    out[k + 2] = a[i] * y - a[i + 1] * x
    out[k + 3] = a[i + 1] * w - a[i + 2] * v + a[i + 4] * z - a[i + 5] * y
    out[k + 4] = a[i + 2] * u - a[i] * w + a[i + 5] * x - a[i + 3] * z
    out[k + 5] = a[i] * v - a[i + 1] * u + a[i + 3] * y - a[i + 4] * x


@compiled
def _force_cross(a: Array, i: int, b: Array, j: int, out: Array, k: int) -> None:
    """Add a ×* b of a motion (ω, v) and a force (n, f)."""
    _cross(a, i, b, j, out, k)
    _cross(a, i + 3, b, j + 3, out, k)
    _cross(a, i, b, j + 3, out, k + 3)


@compiled
def _dot(a: Array, i: int, b: Array, j: int, size: int) -> float:
    total = 0.0
    for k in range(size):
        total += a[i + k] * b[j + k]
    return total


@compiled
def _momentum(row: Array, motion: Array, i: int, out: Array, k: int) -> None:
    """Write I x of the bodies whose mass, first moment and inertia are in `row`, for a motion x: a force."""
    for c in range(3):
        out[k + c] = _dot(row, INERTIA + 3 * c, motion, i, 3)
        out[k + 3 + c] = row[MASS] * motion[i + 3 + c]
    _cross(row, H, motion, i + 3, out, k)
    _cross(motion, i, row, H, out, k + 3)


@compiled
def kinematics(constants: Array, gravity: Array, motion: Array, order: Indices, work: Array) -> None:
    """Fill R, ORIGIN, S, E, V and A of each joint, base to tip.

    constants: (n, CONSTANTS), see `Geometry.constants`; gravity: (3,) m/s² in the base's frame; motion: (3, n), q, dq
    and ddq in the order of the data; order: (n,), the data's joint at each place of the chain; work: (n + 1, WORK),
    whose last row is the base.
    """
    n = constants.shape[0]
    base = work[n]
    base[: A + 6] = 0.0
    base[R] = base[R + 4] = base[R + 8] = 1.0
    for c in range(3):
        base[A + 3 + c] = -gravity[c]
    for j in range(n):
        fixed, row, before = constants[j], work[j], work[j - 1 if j else n]
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
            row[ORIGIN + r] = before[ORIGIN + r] + _dot(before, R + 3 * r, fixed, PLACE, 3)
            row[E + r] = _dot(before, R + 3 * r, fixed, ACROSS, 3)
            row[E + 3 + r] = _dot(before, R + 3 * r, fixed, ACROSS + 3, 3)
            axis = _dot(before, R + 3 * r, fixed, AXIS, 3)
            row[S + r] = axis if revolute else 0.0
            row[S + 3 + r] = 0.0 if revolute else axis
        if revolute:
            _cross(row, ORIGIN, row, S, row, S + 3)
        _moving_cross(before, V, row, S, row, A)
        for c in range(6):
            row[A + c] = before[A + c] + row[S + c] * ddq + row[A + c] * dq
            row[V + c] = before[V + c] + row[S + c] * dq
        row[_SPARE] = slide  # the frame's own origin lies there; the screws across the axis act where it is at zero
        if not revolute:
            for c in range(3):
                row[ORIGIN + c] += slide * row[S + 3 + c]


@compiled
def masses(constants: Array, order: Indices, work: Array, table: Array, out: Array) -> None:
    """Write ∂τ/∂π after `kinematics`: rows 10 k to 10 k + 9 of `out` belong to the body of the data's joint k, columns
    to the data's joints; rows of bodies that do not load a joint are zero there. out: (at least 10 n, n)."""
    n = constants.shape[0]
    out[: PARAMETERS * n] = 0.0
    for j in range(n):
        row, first = work[j], PARAMETERS * order[j]
        _link_table(row, table)
        for i in range(j + 1):
            joint, screw = work[i], order[i]
            # the screw of joint i as the frame of link j sees it
            for c in range(3):
                table[AT_LINK + 3 + c] = joint[S + 3 + c]
            _cross(joint, S, row, ORIGIN, table, AT_LINK + 3)
            for c in range(3):
                angular = linear = 0.0
                for k in range(3):
                    angular += row[R + 3 * k + c] * joint[S + k]
                    linear += row[R + 3 * k + c] * table[AT_LINK + 3 + k]
                table[AT_LINK + c] = angular
                table[AT_LINK + 6 + c] = linear
            for p in range(PARAMETERS):
                total = 0.0
                for c in range(3):
                    total += table[AT_LINK + c] * table[MOMENT_OF + 10 * c + p]
                    total += table[AT_LINK + 6 + c] * table[FORCE_OF + 10 * c + p]
                out[first + p, screw] = total


@compiled
def _link_table(row: Array, t: Array) -> None:
    """Force and moment about its origin that a body needs, by each of its ten parameters, in its own frame."""
    t[:AT_LINK] = 0.0
    at = AT_LINK
    # acceleration of the frame's origin less gravity: A + α × o + ω × (v + ω × o)
    for c in range(3):
        t[at + c] = row[V + 3 + c]
        t[at + 3 + c] = row[A + 3 + c]
    _cross(row, V, row, ORIGIN, t, at)
    _cross(row, V, t, at, t, at + 3)
    _cross(row, A, row, ORIGIN, t, at + 3)
    for c in range(3):
        x = y = z = 0.0
        for k in range(3):
            turn = row[R + 3 * k + c]
            x += turn * t[at + 3 + k]
            y += turn * row[V + k]
            z += turn * row[A + k]
        t[at + 6 + c], t[at + 9 + c], t[at + 12 + c] = x, y, z
    a0, a1, a2 = t[at + 6], t[at + 7], t[at + 8]
    x, y, z = t[at + 9], t[at + 10], t[at + 11]
    g0, g1, g2 = t[at + 12], t[at + 13], t[at + 14]
    # force: m a + (α× + ω× ω×) h
    t[0], t[10], t[20] = a0, a1, a2
    t[1], t[2], t[3] = -(y * y + z * z), x * y - g2, x * z + g1
    t[11], t[12], t[13] = x * y + g2, -(x * x + z * z), y * z - g0
    t[21], t[22], t[23] = x * z - g1, y * z + g0, -(x * x + y * y)
    # moment: h × a + I α + ω × I ω
    t[32], t[33] = a2, -a1
    t[41], t[43] = -a2, a0
    t[51], t[52] = a1, -a0
    t[34], t[35], t[36], t[37], t[38], t[39] = g0, g1 - x * z, -y * z, g2 + x * y, y * y - z * z, y * z
    t[44], t[45], t[46], t[47], t[48], t[49] = x * z, g0 + y * z, g1, z * z - x * x, g2 - x * y, -x * z
    t[54], t[55], t[56], t[57], t[58], t[59] = -x * y, x * x - y * y, x * y, g0 - y * z, g1 + x * z, g2


@compiled
def bodies(constants: Array, parameters: Array, work: Array) -> None:
    """Fill MASS, H, INERTIA, P, N and F of each joint with the sums from its body to the tip, after `kinematics`.

    parameters: (n, 10) of the bodies, base to tip.
    """
    n = constants.shape[0]
    for j in range(n - 1, -1, -1):
        row, body = work[j], parameters[j]
        _place_body(row, body)
        spare = row[_PSI:]  # not yet in use
        _momentum(row, row, V, spare, 0)
        for c in range(3):
            row[P + c] = spare[3 + c]
        _momentum(row, row, A, row, F)
        _force_cross(row, V, spare, 0, row, F)
        _coriolis(row)
        if j < n - 1:
            for c in range(MASS, F + 6):
                row[c] += work[j + 1, c]


@compiled
def _place_body(row: Array, body: Array) -> None:
    """MASS, H and INERTIA of one body about the base's origin."""
    mass = body[0]
    row[MASS] = mass
    for c in range(3):  # about its own origin first
        row[_SPARE + 1 + c] = _dot(row, R + 3 * c, body, 1, 3)
        row[H + c] = row[_SPARE + 1 + c] + mass * row[ORIGIN + c]
    for r in range(3):
        r0, r1, r2 = row[R + 3 * r], row[R + 3 * r + 1], row[R + 3 * r + 2]
        x = r0 * body[4] + r1 * body[5] + r2 * body[7]
        y = r0 * body[5] + r1 * body[6] + r2 * body[8]
        z = r0 * body[7] + r1 * body[8] + r2 * body[9]
        for c in range(3):
            row[INERTIA + 3 * r + c] = x * row[R + 3 * c] + y * row[R + 3 * c + 1] + z * row[R + 3 * c + 2]
    # Steiner: − h× o× − o× h× − m o× o×, with a× b× = b aᵀ − (a·b) 1
    inner = 2 * _dot(row, _SPARE + 1, row, ORIGIN, 3) + mass * _dot(row, ORIGIN, row, ORIGIN, 3)
    for r in range(3):
        for c in range(3):
            cross = row[_SPARE + 1 + r] * row[ORIGIN + c] + row[ORIGIN + r] * row[_SPARE + 1 + c]
            row[INERTIA + 3 * r + c] -= cross + mass * row[ORIGIN + r] * row[ORIGIN + c]
        row[INERTIA + 4 * r] += inner


@compiled
def _coriolis(row: Array) -> None:
    """N of one body: 2 ω× Ī − tr Ī ω× − 2 h× v×."""
    trace = row[INERTIA] + row[INERTIA + 4] + row[INERTIA + 8]
    column = row[_SPARE + 1 : _SPARE + 10]
    inner = _dot(row, H, row, V + 3, 3)
    for c in range(3):
        for k in range(3):
            column[k] = 2 * row[INERTIA + 3 * k + c]
            column[3 + k] = 0.0
        column[c] -= trace
        _cross(row, V, column, 0, column, 3)
        for r in range(3):
            row[N + 3 * r + c] = column[3 + r] - 2 * row[V + 3 + r] * row[H + c]
        row[N + 4 * c] += 2 * inner


@compiled
def torques(order: Indices, work: Array, out: Array) -> None:
    """Write τ, (n,) in the order of the data, after `bodies`."""
    for i in range(order.shape[0]):
        out[order[i]] = _dot(work[i], S, work[i], F, 6)


@compiled
def shapes(constants: Array, order: Indices, work: Array, out: Array) -> None:
    """Write ∂τ/∂θ after `bodies`: a row for each number of the geometry, base to tip, columns as the data's joints.

    A joint's numbers are turns about the two vectors across its axis, then shifts along them, as many as
    constants[j, SCREWS] says: 4, 2 (no shifts) or 0.
    """
    n = constants.shape[0]
    for i in range(n):
        row = work[i]
        _momentum(row, row, S, row, D)
        for c in range(3):
            row[G + c] = row[S] * row[N + c] + row[S + 1] * row[N + 3 + c] + row[S + 2] * row[N + 6 + c]
            row[_SPARE + 1 + c] = 2 * row[P + c]
        _cross(row, _SPARE + 1, row, S + 3, row, G)
    at = 0
    for j in range(n):
        row, before = work[j], work[j - 1 if j else n]
        for number in range(int(constants[j, SCREWS])):
            _screw(row, number)
            _moving_cross(before, V, row, _SCREW, row, _PSI)
            _moving_cross(before, V, row, _PSI, row, _PSI2)
            _moving_cross(before, A, row, _SCREW, row, _SPARE + 1)
            for c in range(6):
                row[_PSI2 + c] += row[_SPARE + 1 + c]
            _momentum(row, row, _PSI2, row, _FORCE)
            for c in range(3):
                row[_FORCE + c] += _dot(row, N + 3 * c, row, _PSI, 3)
                row[_SPARE + 1 + c] = 2 * row[P + c]
            _cross(row, _PSI, row, _SPARE + 1, row, _FORCE + 3)
            _force_cross(row, _SCREW, row, F, row, _FORCE)
            for i in range(j):
                out[at, order[i]] = _dot(work[i], S, row, _FORCE, 6)
            for i in range(j, n):
                out[at, order[i]] = _dot(work[i], D, row, _PSI2, 6) + _dot(work[i], G, row, _PSI, 3)
            at += 1


@compiled
def _screw(row: Array, number: int) -> None:
    """The screw of a joint's number: a turn about, or a shift along, a vector across its axis."""
    vector = E + 3 * (number % 2)
    for c in range(3):
        row[_SCREW + c] = row[vector + c] if number < 2 else 0.0
        row[_SCREW + 3 + c] = 0.0 if number < 2 else row[vector + c]
    if number < 2:
        # about the frame's place at zero, which a prismatic joint has left along its axis
        for c in range(3):
            row[_SPARE + 1 + c] = row[ORIGIN + c] - row[_SPARE] * row[S + 3 + c]
        _cross(row, _SPARE + 1, row, vector, row, _SCREW + 3)


@compiled
def arm_rows(
    constants: Array,
    gravity: Array,
    parameters: Array,
    order: Indices,
    motion: Array,
    work: Array,
    table: Array,
    out: Array,
) -> None:
    """Features of one query: ∂τ/∂π, ddq of each joint (its rotor), ∂τ/∂θ; (10 n + n + g, n), see `ArmKernel`."""
    n = constants.shape[0]
    kinematics(constants, gravity, motion, order, work)
    masses(constants, order, work, table, out)
    first = PARAMETERS * n
    out[first : first + n] = 0.0
    for j in range(n):
        out[first + j, j] = motion[2, j]
    if out.shape[0] > first + n:
        bodies(constants, parameters, work)
        shapes(constants, order, work, out[first + n :])


@compiled
def arm_query(memory: Array, order: Indices, motion: Array, out: Array) -> None:
    """`arm_rows` of one query, with one array for all that taking over nine costs time: `Memory` of constants, gravity
    and parameters, with (n + 1) WORK + TABLE elements to work in."""
    n = order.shape[0]
    place = n * CONSTANTS
    bodies = place + 3
    work = bodies + n * PARAMETERS
    arm_rows(
        plane(memory, 0, n, CONSTANTS),
        memory[place:bodies],
        plane(memory, bodies, n, PARAMETERS),
        order,
        motion,
        plane(memory, work, n + 1, WORK),
        memory[work + (n + 1) * WORK :],
        out,
    )


@compiled
def arm_features(
    constants: Array, gravity: Array, parameters: Array, order: Indices, motions: Array, out: Array
) -> None:
    """`arm_rows` of N queries: motions (N, 3, n), out (N, p, n)."""
    work, table = np.zeros((constants.shape[0] + 1, WORK)), np.zeros(TABLE)
    for k in range(motions.shape[0]):
        arm_rows(constants, gravity, parameters, order, motions[k], work, table, out[k])


@compiled
def arm_torques(
    constants: Array, gravity: Array, parameters: Array, order: Indices, motions: Array, out: Array
) -> None:
    """Torque of N queries by recursive Newton–Euler: motions (N, 3, n), out (N, n)."""
    work = np.zeros((constants.shape[0] + 1, WORK))
    for k in range(motions.shape[0]):
        kinematics(constants, gravity, motions[k], order, work)
        bodies(constants, parameters, work)
        torques(order, work, out[k])


@compiled
def arm_energies(
    constants: Array, gravity: Array, parameters: Array, order: Indices, motions: Array, out: Array
) -> None:
    """Kinetic and potential energy of N queries by each feature of `arm_rows`: out (N, 2, p), J.

    ½ (Vᵀ I V) and −g · h are linear in π. A displacement s of a subtree changes them by P · (V × s) and by the work
    −s · (h × g, m g). ddq of motions is not read.
    """
    n = constants.shape[0]
    work, link = np.zeros((n + 1, WORK)), np.zeros(24)
    first = PARAMETERS * n
    for k in range(motions.shape[0]):
        kinematics(constants, gravity, motions[k], order, work)
        out[k] = 0.0
        for j in range(n):
            row, at = work[j], PARAMETERS * order[j]
            link[:] = 0.0
            for c in range(3):
                link[c] = row[V + 3 + c]
            _cross(row, V, row, ORIGIN, link, 0)
            for c in range(3):
                for i in range(3):
                    turn = row[R + 3 * i + c]
                    link[3 + c] += turn * link[i]  # velocity of the origin, its frame
                    link[6 + c] += turn * row[V + i]
                    link[9 + c] += turn * gravity[i]
            _cross(link, 3, link, 6, link, 12)  # v · (ω × h) = h · (v × ω)
            x, y, z = link[6], link[7], link[8]
            out[k, 0, at] = 0.5 * _dot(link, 3, link, 3, 3)
            out[k, 1, at] = -_dot(row, ORIGIN, gravity, 0, 3)
            for c in range(3):
                out[k, 0, at + 1 + c] = link[12 + c]
                out[k, 1, at + 1 + c] = -link[9 + c]
            out[k, 0, at + 4], out[k, 0, at + 5], out[k, 0, at + 6] = 0.5 * x * x, x * y, 0.5 * y * y
            out[k, 0, at + 7], out[k, 0, at + 8], out[k, 0, at + 9] = x * z, y * z, 0.5 * z * z
            out[k, 0, first + order[j]] = 0.5 * motions[k, 1, order[j]] ** 2
        if out.shape[2] == first + n:
            continue
        bodies(constants, parameters, work)
        _sum_momenta(parameters, work)
        at = first + n
        for j in range(n):
            row, before = work[j], work[j - 1 if j else n]
            for number in range(int(constants[j, SCREWS])):
                _screw(row, number)
                _moving_cross(before, V, row, _SCREW, row, _PSI)
                out[k, 0, at] = _dot(row, D, row, _PSI, 6)
                link[:6] = 0.0
                _cross(row, H, gravity, 0, link, 0)
                for c in range(3):
                    link[3 + c] = row[MASS] * gravity[c]
                out[k, 1, at] = -_dot(row, _SCREW, link, 0, 6)
                at += 1


@compiled
def _sum_momenta(parameters: Array, work: Array) -> None:
    """D of each joint: momentum (L, p) of all bodies from its own to the tip; their sums of masses are kept."""
    n = parameters.shape[0]
    for j in range(n - 1, -1, -1):
        row = work[j]
        kept = row[MASS : INERTIA + 9].copy()
        _place_body(row, parameters[j])
        _momentum(row, row, V, row, D)
        row[MASS : INERTIA + 9] = kept
        if j < n - 1:
            for c in range(6):
                row[D + c] += work[j + 1, D + c]


@compiled
def arm_masses(constants: Array, gravity: Array, order: Indices, motions: Array, out: Array) -> None:
    """∂τ/∂π of N queries: motions (N, 3, n), out (N, 10 n, n)."""
    work, table = np.zeros((constants.shape[0] + 1, WORK)), np.zeros(TABLE)
    for k in range(motions.shape[0]):
        kinematics(constants, gravity, motions[k], order, work)
        masses(constants, order, work, table, out[k])


@compiled
def arm_shapes(constants: Array, gravity: Array, parameters: Array, order: Indices, motions: Array, out: Array) -> None:
    """∂τ/∂θ of N queries: motions (N, 3, n), out (N, g, n)."""
    work = np.zeros((constants.shape[0] + 1, WORK))
    for k in range(motions.shape[0]):
        kinematics(constants, gravity, motions[k], order, work)
        bodies(constants, parameters, work)
        shapes(constants, order, work, out[k])


@compiled
def arm_differences(
    mixing: Array,
    constants: Array,
    gravity: Array,
    parameters: Array,
    linear: Array,
    order: Indices,
    motions: Array,
    features: Array,
    out: Array,
) -> None:
    """Lᵀ δ of N queries, δ the torque of each of K arms less that of the first.

    mixing: L (K, K), lower triangular; constants: (K + 1, n, CONSTANTS); parameters: (K + 1, n, 10); linear:
    (K + 1, n, l), coefficients of `features` (N, n, l) of each joint; motions (N, 3, n), out (N, K, n).
    """
    n = order.shape[0]
    work, first, other = np.zeros((n + 1, WORK)), np.zeros(n), np.zeros(n)
    for k in range(motions.shape[0]):
        for arm in range(constants.shape[0]):
            kinematics(constants[arm], gravity, motions[k], order, work)
            bodies(constants[arm], parameters[arm], work)
            torques(order, work, other if arm else first)
            for j in range(n):
                added = _dot(linear[arm, j], 0, features[k, j], 0, features.shape[2])
                if arm:
                    out[k, arm - 1, j] = other[j] + added - first[j]
                else:
                    first[j] += added
        for row in range(mixing.shape[0]):  # those below are not yet mixed
            for j in range(n):
                total = 0.0
                for arm in range(row, mixing.shape[0]):
                    total += mixing[arm, row] * out[k, arm, j]
                out[k, row, j] = total

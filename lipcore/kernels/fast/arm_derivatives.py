"""Derivatives of an arm's torque by its masses and by its geometry, docs/method.md (12) and (15) to (17).

Let the subtree of joint j be displaced by a screw s that is fixed to the body before it (velocity V, acceleration A).
Its bodies then have the additional velocity ψ̇ = V × s and acceleration ψ̈ = A × s + V × ψ̇, and the force turns with
them:

    i < j:   ∂τ_i = S_iᵀ (I_j ψ̈ + 2 B_j ψ̇ + s ×* F_j)          i ≥ j:   ∂τ_i = S_iᵀ (I_i ψ̈ + 2 B_i ψ̇)

with 2 B δ = δ ×* (I V) + V ×* (I δ) − I (V × δ) for a change δ of velocity. (This is ∂τ/∂q of Singh, Russell & Wensing
2022 with any screw instead of a joint's own.) Written out with Jacobi's identity, only the angular part w of δ remains,
and sums over bodies stay sums:  2 B δ = (N w, 2 w × p),  N = Σ 2 (ω× Ī − ½ tr Ī ω×) − 2 h× v×.
"""

from __future__ import annotations

import numpy as np

from lipcore.kernels.fast.arm_recursion import (
    FORCE,
    MASS,
    ORIGIN,
    PARAMETERS,
    PSI,
    PSI2,
    ROOT,
    SCREW,
    SCREWS,
    SPARE,
    A,
    Array,
    D,
    E,
    F,
    G,
    H,
    Indices,
    N,
    P,
    R,
    S,
    V,
    add_cross,
    add_force_cross,
    bodies,
    dot,
    momentum,
    moving_cross,
    row_before,
    sum_momenta,
)
from lipcore.kernels.fast.compile import compiled

# offsets in the table of `masses`: 3 × 10 numbers for force and for moment, then values of a body
FORCE_OF, MOMENT_OF, AT_LINK = 0, 30, 60
TABLE = 80


@compiled
def masses(constants: Array, order: Indices, work: Array, table: Array, out: Array) -> None:
    """Write ∂τ/∂π after `kinematics`, (at least 10 n, n).

    Rows 10 k to 10 k + 9 of `out` belong to the body of the data's joint k, columns to the data's joints. If a body
    does not load a joint, its rows are zero there.
    """
    n = constants.shape[0]
    out[: PARAMETERS * n] = 0.0
    for j in range(n):
        link_masses(constants, order, work, j, table, out, PARAMETERS * order[j])


@compiled
def link_masses(constants: Array, order: Indices, work: Array, j: int, table: Array, out: Array, first: int) -> None:
    """Write ∂τ/∂π of the body at place j of the chain after `kinematics`, to ten rows of `out` from `first` on.

    Columns of joints after place j, and of other arms, are not written.
    """
    row = work[j]
    _link_table(row, table)
    for i in range(int(constants[j, ROOT]), j + 1):
        joint, screw = work[i], order[i]
        # the screw of joint i in the frame of link j
        for c in range(3):
            table[AT_LINK + 3 + c] = joint[S + 3 + c]
        add_cross(joint, S, row, ORIGIN, table, AT_LINK + 3)
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
    """Write the force and moment about its origin that a body needs, by each of its ten parameters, in its frame."""
    t[:AT_LINK] = 0.0
    at = AT_LINK
    # acceleration of the frame's origin minus gravity: A + α × o + ω × (v + ω × o)
    for c in range(3):
        t[at + c] = row[V + 3 + c]
        t[at + 3 + c] = row[A + 3 + c]
    add_cross(row, V, row, ORIGIN, t, at)
    add_cross(row, V, t, at, t, at + 3)
    add_cross(row, A, row, ORIGIN, t, at + 3)
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
def shapes(constants: Array, order: Indices, work: Array, out: Array) -> None:
    """Write ∂τ/∂θ after `bodies`: a row for each number of the geometry, base to tip, columns as the data's joints.

    A joint's numbers are turns about the two vectors across its axis, then shifts along them. constants[j, SCREWS] is
    their count: 4, 2 (no shifts) or 0.
    """
    n = constants.shape[0]
    for i in range(n):
        row = work[i]
        momentum(row, row, S, row, D)
        for c in range(3):
            row[G + c] = row[S] * row[N + c] + row[S + 1] * row[N + 3 + c] + row[S + 2] * row[N + 6 + c]
            row[SPARE + 1 + c] = 2 * row[P + c]
        add_cross(row, SPARE + 1, row, S + 3, row, G)
    at = 0
    for j in range(n):
        row, before = work[j], work[row_before(constants, j)]
        for number in range(int(constants[j, SCREWS])):
            _screw(row, number)
            moving_cross(before, V, row, SCREW, row, PSI)
            moving_cross(before, V, row, PSI, row, PSI2)
            moving_cross(before, A, row, SCREW, row, SPARE + 1)
            for c in range(6):
                row[PSI2 + c] += row[SPARE + 1 + c]
            momentum(row, row, PSI2, row, FORCE)
            for c in range(3):
                row[FORCE + c] += dot(row, N + 3 * c, row, PSI, 3)
                row[SPARE + 1 + c] = 2 * row[P + c]
            add_cross(row, PSI, row, SPARE + 1, row, FORCE + 3)
            add_force_cross(row, SCREW, row, F, row, FORCE)
            for i in range(n):
                if constants[i, ROOT] != constants[j, ROOT]:
                    out[at, order[i]] = 0.0
                elif i < j:
                    out[at, order[i]] = dot(work[i], S, row, FORCE, 6)
                else:
                    out[at, order[i]] = dot(work[i], D, row, PSI2, 6) + dot(work[i], G, row, PSI, 3)
            at += 1


@compiled
def _screw(row: Array, number: int) -> None:
    """Write the screw of a joint's number: a turn about, or a shift along, a vector across its axis."""
    vector = E + 3 * (number % 2)
    for c in range(3):
        row[SCREW + c] = row[vector + c] if number < 2 else 0.0
        row[SCREW + 3 + c] = 0.0 if number < 2 else row[vector + c]
    if number < 2:
        # the turn is about the frame's place at q = 0, which a prismatic joint has left along its axis
        for c in range(3):
            row[SPARE + 1 + c] = row[ORIGIN + c] - row[SPARE] * row[S + 3 + c]
        add_cross(row, SPARE + 1, row, vector, row, SCREW + 3)


@compiled
def energies(
    constants: Array, gravity: Array, parameters: Array, order: Indices, motion: Array, work: Array, out: Array
) -> None:
    """Write kinetic and potential energy by masses, rotors and geometry after `kinematics`, (2, 11 n or 11 n + g) J.

    ½ (Vᵀ I V) and −g · h are linear in π. A displacement s of a subtree changes them by P · (V × s) and by the work
    −s · (h × g, m g).
    """
    n, first = constants.shape[0], PARAMETERS * constants.shape[0]
    link = np.zeros(24)
    out[:] = 0.0
    for j in range(n):
        row, at = work[j], PARAMETERS * order[j]
        link[:] = 0.0
        for c in range(3):
            link[c] = row[V + 3 + c]
        add_cross(row, V, row, ORIGIN, link, 0)
        for c in range(3):
            for i in range(3):
                turn = row[R + 3 * i + c]
                link[3 + c] += turn * link[i]  # velocity of the origin, its frame
                link[6 + c] += turn * row[V + i]
                link[9 + c] += turn * gravity[i]
        add_cross(link, 3, link, 6, link, 12)  # v · (ω × h) = h · (v × ω)
        x, y, z = link[6], link[7], link[8]
        out[0, at] = 0.5 * dot(link, 3, link, 3, 3)
        out[1, at] = -dot(row, ORIGIN, gravity, 0, 3)
        for c in range(3):
            out[0, at + 1 + c] = link[12 + c]
            out[1, at + 1 + c] = -link[9 + c]
        out[0, at + 4], out[0, at + 5], out[0, at + 6] = 0.5 * x * x, x * y, 0.5 * y * y
        out[0, at + 7], out[0, at + 8], out[0, at + 9] = x * z, y * z, 0.5 * z * z
        out[0, first + order[j]] = 0.5 * motion[1, order[j]] ** 2
    at = first + n
    if out.shape[1] == at:
        return
    bodies(constants, parameters, work)
    sum_momenta(constants, parameters, work)
    for j in range(n):
        row, before = work[j], work[row_before(constants, j)]
        for number in range(int(constants[j, SCREWS])):
            _screw(row, number)
            moving_cross(before, V, row, SCREW, row, PSI)
            out[0, at] = dot(row, D, row, PSI, 6)
            link[:6] = 0.0
            add_cross(row, H, gravity, 0, link, 0)
            for c in range(3):
                link[3 + c] = row[MASS] * gravity[c]
            out[1, at] = -dot(row, SCREW, link, 0, 6)
            at += 1

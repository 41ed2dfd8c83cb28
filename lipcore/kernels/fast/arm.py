"""Torques, features and energies of an arm for many motions, and the features of one query.

The recursion is `arm_recursion`, its derivatives are `arm_derivatives`. Common arguments:

- constants: (n, CONSTANTS), from `Geometry.constants`;
- gravity: (3,), m/s² in the base's frame;
- parameters: (n, 10) of the bodies, base to tip;
- order: (n,), the data's joint at each place of the chain;
- motions: (N, 3, n), q, dq and ddq in the order of the data.
"""

from __future__ import annotations

import numpy as np

from lipcore.kernels.fast.arm_derivatives import TABLE, energies, masses, shapes
from lipcore.kernels.fast.arm_recursion import (
    CONSTANTS,
    WORK,
    Array,
    Indices,
    bodies,
    dot,
    kinematics,
    torques,
)
from lipcore.kernels.fast.arm_recursion import PARAMETERS as PARAMETERS  # noqa: PLC0414 - searches take it from here
from lipcore.kernels.fast.compile import brief, compiled
from lipcore.kernels.fast.views import numbers


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
    """Write the features of one query, (10 n + n + g, n): ∂τ/∂π, ddq of each joint for its rotor, and ∂τ/∂θ."""
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


def arm_size(n: int) -> int:
    """Return the number of elements that `arm_query` works in."""
    return (n + 1) * WORK + TABLE


@brief
def arm_query(memory: Array, order: Indices, motion: Array, out: Array) -> None:
    """Write the features of one query, see `arm_rows`.

    memory: `Memory` of constants, gravity and parameters, with `arm_size` elements to work in. Passing nine arrays
    would cost time.
    """
    n = order.shape[0]
    place = n * CONSTANTS
    bodies = place + 3
    work = bodies + n * PARAMETERS
    arm_rows(
        numbers(memory, 0, (n, CONSTANTS)),
        memory[place:bodies],
        numbers(memory, bodies, (n, PARAMETERS)),
        order,
        motion,
        numbers(memory, work, (n + 1, WORK)),
        memory[work + (n + 1) * WORK :],
        out,
    )


@compiled
def arm_queries(memory: Array, order: Indices, motions: Array, out: Array, first: int, last: int) -> None:
    """Write the features of N queries, (N, 3, n), into rows `first` to `last` of each part of `out`, (N, …, n)."""
    for k in range(motions.shape[0]):
        arm_query(memory, order, motions[k], out[k, first:last])


@compiled
def arm_torques(
    constants: Array, gravity: Array, parameters: Array, order: Indices, motions: Array, out: Array
) -> None:
    """Write the torques of N queries, (N, n), by recursive Newton–Euler. motions: (N, 3, n)."""
    work = np.zeros((constants.shape[0] + 1, WORK))
    for k in range(motions.shape[0]):
        kinematics(constants, gravity, motions[k], order, work)
        bodies(constants, parameters, work)
        torques(order, work, out[k])


@compiled
def arm_masses(constants: Array, gravity: Array, order: Indices, motions: Array, out: Array) -> None:
    """Write ∂τ/∂π of N queries, (N, 10 n, n). motions: (N, 3, n)."""
    work, table = np.zeros((constants.shape[0] + 1, WORK)), np.zeros(TABLE)
    for k in range(motions.shape[0]):
        kinematics(constants, gravity, motions[k], order, work)
        masses(constants, order, work, table, out[k])


@compiled
def arm_shapes(constants: Array, gravity: Array, parameters: Array, order: Indices, motions: Array, out: Array) -> None:
    """Write ∂τ/∂θ of N queries, (N, g, n). motions: (N, 3, n)."""
    work = np.zeros((constants.shape[0] + 1, WORK))
    for k in range(motions.shape[0]):
        kinematics(constants, gravity, motions[k], order, work)
        bodies(constants, parameters, work)
        shapes(constants, order, work, out[k])


@compiled
def arm_energies(
    constants: Array, gravity: Array, parameters: Array, order: Indices, motions: Array, out: Array
) -> None:
    """Write the kinetic and the potential energy of N queries by each feature of `arm_rows`, (N, 2, p) J.

    ddq is not read.
    """
    n = constants.shape[0]
    work = np.zeros((n + 1, WORK))
    for k in range(motions.shape[0]):
        kinematics(constants, gravity, motions[k], order, work)
        energies(constants, gravity, parameters, order, motions[k], work, out[k])


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
    """Write Lᵀ δ of N queries, (N, K, n), δ the torque of each of K arms minus that of the first arm.

    mixing: L (K, K), lower triangular; constants: (K + 1, n, CONSTANTS); parameters: (K + 1, n, 10); linear:
    (K + 1, n, l), coefficients of `features` (N, n, l) of each joint; motions: (N, 3, n).
    """
    n = order.shape[0]
    work, first, other = np.zeros((n + 1, WORK)), np.zeros(n), np.zeros(n)
    for k in range(motions.shape[0]):
        for arm in range(constants.shape[0]):
            kinematics(constants[arm], gravity, motions[k], order, work)
            bodies(constants[arm], parameters[arm], work)
            torques(order, work, other if arm else first)
            for j in range(n):
                added = dot(linear[arm, j], 0, features[k, j], 0, features.shape[2])
                if arm:
                    out[k, arm - 1, j] = other[j] + added - first[j]
                else:
                    first[j] += added
        for row in range(mixing.shape[0]):  # the rows below are not mixed yet
            for j in range(n):
                total = 0.0
                for arm in range(row, mixing.shape[0]):
                    total += mixing[arm, row] * out[k, arm, j]
                out[k, row, j] = total

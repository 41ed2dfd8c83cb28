"""What is asked of a payload at the tip of an arm: its features, see `kernels.payload.PayloadKernel`.

Arguments that all have in common: constants (s, n, CONSTANTS), of the geometry θ and, where s is 3, of those NEAR of a
step ahead of it and as far behind; gravity (3,) and order (n,) as in `arm`; payload (10,), π̄.
"""

from __future__ import annotations

from lipcore.kernels.compiled.arm_derivatives import TABLE, link_masses
from lipcore.kernels.compiled.arm_recursion import CONSTANTS, PARAMETERS, WORK, Array, Indices, kinematics
from lipcore.kernels.compiled.compile import brief, compiled
from lipcore.kernels.compiled.views import numbers

NEAR = 1e-4
"""Share of a step over which differences stand for the derivative along it."""


@compiled
def payload_rows(
    constants: Array, gravity: Array, payload: Array, order: Indices, motion: Array, work: Array, out: Array
) -> None:
    """Features of one query, (11, n): b + b' and −b' π̄, b = ∂τ/∂π of the last link, b' its change with the step.

    work: (n + 1, WORK) and more rows, as many as `payload_size` asks for.
    """
    n = order.shape[0]
    chain, table = work[: n + 1], work[n + 1]
    kinematics(constants[0], gravity, motion, order, chain)
    link_masses(order, chain, n - 1, table, out, 0)
    out[PARAMETERS] = 0.0
    for side in range(1, constants.shape[0]):
        masses = numbers(work[n + 1], TABLE, (PARAMETERS, n))
        kinematics(constants[side], gravity, motion, order, chain)
        link_masses(order, chain, n - 1, table, masses, 0)
        for p in range(PARAMETERS):
            for j in range(n):
                change = (0.5 if side == 1 else -0.5) / NEAR * masses[p, j]
                out[p, j] += change
                out[PARAMETERS, j] -= payload[p] * change


def payload_size(n: int) -> int:
    """Rows of WORK elements that `payload_rows` works in."""
    return n + 1 - (-(TABLE + PARAMETERS * n) // WORK)


@brief
def payload_query(memory: Array, sides: int, order: Indices, motion: Array, out: Array) -> None:
    """`payload_rows` of one query, with one array for all: `Memory` of constants, gravity and payload, with
    `payload_size` rows to work in. sides: s."""
    n = order.shape[0]
    gravity = sides * n * CONSTANTS
    payload = gravity + 3
    work = payload + PARAMETERS
    payload_rows(
        numbers(memory, 0, (sides, n, CONSTANTS)),
        memory[gravity:payload],
        memory[payload:work],
        order,
        motion,
        numbers(memory, work, ((memory.shape[0] - work) // WORK, WORK)),
        out,
    )


@compiled
def payload_queries(memory: Array, sides: int, order: Indices, motions: Array, out: Array, first: int) -> None:
    """`payload_query` of N queries, (N, 3, n), into the rows of each of `out`, (N, …, n), from `first` on."""
    for k in range(motions.shape[0]):
        payload_query(memory, sides, order, motions[k], out[k, first : first + PARAMETERS + 1])


@compiled
def payload_features(
    constants: Array, gravity: Array, payload: Array, order: Indices, motions: Array, work: Array, out: Array
) -> None:
    """`payload_rows` of N queries: motions (N, 3, n), out (N, 11, n)."""
    for k in range(motions.shape[0]):
        payload_rows(constants, gravity, payload, order, motions[k], work, out[k])

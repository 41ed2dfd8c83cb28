"""What is asked of a payload at the tip of an arm: its features, see `kernels.payload.PayloadKernel`.

Arguments that all have in common: constants (n, CONSTANTS), gravity (3,) and order (n,) as in `arm`.
"""

from __future__ import annotations

from lipcore.kernels.compiled.arm_derivatives import TABLE, link_masses
from lipcore.kernels.compiled.arm_recursion import CONSTANTS, WORK, Array, Indices, kinematics
from lipcore.kernels.compiled.compile import compiled
from lipcore.kernels.compiled.views import numbers


@compiled
def payload_rows(
    constants: Array, gravity: Array, order: Indices, motion: Array, work: Array, table: Array, out: Array
) -> None:
    """Features of one query, ∂τ/∂π of the last link, (10, n). work: (n + 1, WORK), table: (TABLE,)."""
    kinematics(constants, gravity, motion, order, work)
    link_masses(order, work, order.shape[0] - 1, table, out, 0)


def payload_size(n: int) -> int:
    """Elements that `payload_query` works in."""
    return (n + 1) * WORK + TABLE


@compiled
def payload_query(memory: Array, order: Indices, motion: Array, out: Array) -> None:
    """`payload_rows` of one query, with one array for all: `Memory` of constants and gravity, with `payload_size`
    elements to work in."""
    n = order.shape[0]
    gravity = n * CONSTANTS
    work = gravity + 3
    table = work + (n + 1) * WORK
    payload_rows(
        numbers(memory, 0, (n, CONSTANTS)),
        memory[gravity:work],
        order,
        motion,
        numbers(memory, work, (n + 1, WORK)),
        memory[table:],
        out,
    )


@compiled
def payload_features(
    constants: Array, gravity: Array, order: Indices, motions: Array, work: Array, table: Array, out: Array
) -> None:
    """`payload_rows` of N queries: motions (N, 3, n), out (N, 10, n)."""
    for k in range(motions.shape[0]):
        payload_rows(constants, gravity, order, motions[k], work, table, out[k])

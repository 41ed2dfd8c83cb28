"""Features of a payload at the tip of an arm, see `kernels.payload.PayloadKernel`."""

from __future__ import annotations

from lipcore.kernels.fast.arm_derivatives import TABLE, link_masses
from lipcore.kernels.fast.arm_recursion import CONSTANTS, PARAMETERS, WORK, Array, Indices, kinematics
from lipcore.kernels.fast.compile import brief, compiled
from lipcore.kernels.fast.views import numbers


def payload_size(n: int) -> int:
    """Return the number of elements that `payload_query` works in."""
    return (n + 1) * WORK + TABLE


@brief
def payload_query(memory: Array, order: Indices, motion: Array, out: Array) -> None:
    """Write the features of one query, ∂τ/∂π of the last link, (10, n); zero for joints of other arms.

    memory: `Memory` of the geometry's constants and gravity, with `payload_size` elements to work in.
    """
    n = order.shape[0]
    gravity = n * CONSTANTS
    first = gravity + 3
    work = numbers(memory, first, (n + 1, WORK))
    constants = numbers(memory, 0, (n, CONSTANTS))
    kinematics(constants, memory[gravity:first], motion, order, work)
    out[:PARAMETERS] = 0.0
    link_masses(constants, order, work, n - 1, memory[first + (n + 1) * WORK :], out, 0)


@compiled
def payload_queries(memory: Array, order: Indices, motions: Array, out: Array, first: int) -> None:
    """Write the features of N queries, (N, 3, n), into the rows of each part of `out`, (N, …, n), from `first` on."""
    for k in range(motions.shape[0]):
        payload_query(memory, order, motions[k], out[k, first : first + PARAMETERS])

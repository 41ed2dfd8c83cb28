"""A lower triangle times one column, compiled: for the standard deviation of one joint.

Rows are stored HEIGHT at a time, column by column up to the diagonal, as of `answer.pack`.
"""

from __future__ import annotations

from lipcore.kernels.fast.compile import inlined
from lipcore.kernels.fast.joints import Array
from lipcore.kernels.fast.lanes import LANES, spread
from lipcore.kernels.fast.views import lay

PANEL = 4
"""Lanes of rows in a panel."""
HEIGHT = PANEL * LANES
"""Rows of a panel."""


@inlined
def multiply_triangle(triangle: Array, at: int, column: Array, size: int, out: Array) -> None:
    """Write the product of the triangle of `size` rows that begins at `at` with a column.

    out: at least HEIGHT numbers more than `size`; those after the product are overwritten.
    """
    for row in range(0, size, HEIGHT):
        count = min(row + HEIGHT, size)
        (rows,), (y,) = lay(triangle, at, ((count, PANEL),))[0], lay(out, row, ((PANEL,),))[0]
        a = b = c = d = spread(0.0)
        for k in range(count):
            factor = column[k]
            a, b = a + rows[k, 0] * factor, b + rows[k, 1] * factor
            c, d = c + rows[k, 2] * factor, d + rows[k, 3] * factor
        y[0], y[1], y[2], y[3] = a, b, c, d
        at += count * HEIGHT


@inlined
def triangle_size(size: int) -> int:
    """Return how many numbers a triangle of `size` rows has."""
    total = 0
    for row in range(0, size, HEIGHT):
        total += min(row + HEIGHT, size) * HEIGHT
    return total

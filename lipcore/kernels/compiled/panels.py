"""Lower triangular matrix times a few columns: the inner loop of every standard deviation.

BLAS is made for larger products and reaches half of what a core can do on these; it also starts threads when it sees
fit. Here the matrix lies in panels of ROWS rows, each stored column by column up to its diagonal, and one loop in
LLVM's own vectors holds all of ROWS × WIDTH sums in registers (12 of AVX2's 16, two at a time of AVX-512's).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

Array = NDArray[np.float64]

ROWS = 6
"""Rows of a panel."""
WIDTH = 8
"""Columns that a panel is multiplied with; a robot of more joints takes several rounds."""


def pack(matrix: Array, triangular: bool) -> Array:
    """Panels of `matrix`, (K, M), one after the other, flat; zeros fill the last.

    triangular: what lies right of each panel's last diagonal element is zero, and left out.
    """
    panels = []
    for first in range(0, matrix.shape[0], ROWS):
        rows = matrix[first : first + ROWS, : first + ROWS if triangular else None]
        panel = np.zeros((rows.shape[1], ROWS))
        panel[:, : len(rows)] = rows.T
        panels.append(panel.reshape(-1))
    return np.concatenate(panels)


def _multiply(
    _typing: Any, panels: Any, panel: Any, columns: Any, first: Any, count: Any, out: Any, at: Any
) -> tuple[Any, Callable[..., Any]]:
    """out[at:] = Σ_k panels[panel + ROWS k + r] columns[first + WIDTH k + c], (ROWS, WIDTH) at (r, c); k < count, ≥ 1.

    All arrays are flat and float64; count is the number of the panel's columns.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number, vector, word = ir.DoubleType(), ir.VectorType(ir.DoubleType(), WIDTH), arguments[1].type
        undefined, lane0 = ir.Constant(vector, ir.Undefined), ir.Constant(ir.IntType(32), 0)
        everywhere = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)

        def element(array: int, index: Any) -> Any:
            data = context.make_array(signature.args[array])(context, builder, arguments[array]).data
            return builder.gep(data, [index])

        left, right = element(0, arguments[1]), element(2, arguments[3])
        target = element(5, arguments[6])
        start = builder.block
        loop, done = builder.append_basic_block("columns"), builder.append_basic_block("done")
        builder.branch(loop)
        builder.position_at_end(loop)
        k = builder.phi(word)
        sums = [builder.phi(vector) for _ in range(ROWS)]
        row = builder.bitcast(builder.gep(right, [builder.mul(k, word(WIDTH))]), vector.as_pointer())
        factors = builder.load(row, align=8)
        column = builder.gep(left, [builder.mul(k, word(ROWS))])
        grown = []
        for r in range(ROWS):
            one = builder.load(builder.gep(column, [word(r)]), align=8)
            spread = builder.shuffle_vector(builder.insert_element(undefined, one, lane0), undefined, everywhere)
            product = builder.fmul(spread, factors, flags=("contract",))
            grown.append(builder.fadd(sums[r], product, flags=("contract",)))
        following = builder.add(k, word(1))
        for phi, before, after in [(k, word(0), following)] + [
            (total, ir.Constant(vector, [number(0.0)] * WIDTH), new) for total, new in zip(sums, grown, strict=True)
        ]:
            phi.add_incoming(before, start)
            phi.add_incoming(after, loop)
        builder.cbranch(builder.icmp_signed("<", following, arguments[4]), loop, done)
        builder.position_at_end(done)
        for r in range(ROWS):
            builder.store(
                grown[r], builder.bitcast(builder.gep(target, [word(r * WIDTH)]), vector.as_pointer()), align=8
            )
        return context.get_dummy_value()

    index = types.intp
    return types.void(panels, index, columns, index, index, out, index), generate


multiply: Callable[..., None] = intrinsic(_multiply)

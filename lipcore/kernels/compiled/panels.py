"""Lower triangular matrix times a few columns: the inner loop of every standard deviation.

BLAS is made for larger products and reaches half of what a core can do on these; it also starts threads when it sees
fit. Here the matrix lies in panels of ROWS rows, each stored column by column up to its diagonal, and one loop over
Lanes holds all of ROWS × WIDTH sums in registers (12 of AVX2's 16).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.compiled.compile import inlined
from lipcore.kernels.compiled.lanes import LANES, spread
from lipcore.kernels.compiled.views import lay, numbers

Array = NDArray[np.float64]

ROWS = 6
"""Rows of a panel."""
WIDTH = LANES
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


@inlined
def multiply(panels: Array, panel: int, columns: Array, first: int, count: int, out: Array, at: int) -> None:
    """out[at:] = Σ_k panels[panel + ROWS k + r] columns[first + WIDTH k + c], (ROWS, WIDTH) at (r, c); k < count.

    All arrays are flat; count is the number of the panel's columns.
    """
    (x,), (y,) = lay(columns, first, ((count,),))[0], lay(out, at, ((ROWS,),))[0]
    rows = numbers(panels, panel, (count, ROWS))
    a = b = c = d = e = f = spread(0.0)
    for k in range(count):
        factors = x[k]
        a, b, c = a + rows[k, 0] * factors, b + rows[k, 1] * factors, c + rows[k, 2] * factors
        d, e, f = d + rows[k, 3] * factors, e + rows[k, 4] * factors, f + rows[k, 5] * factors
    y[0], y[1], y[2], y[3], y[4], y[5] = a, b, c, d, e, f

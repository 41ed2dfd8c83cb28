"""Programs of single operations, run for blocks of queries: one operation at a time for a whole block.

A block of each number is a row of a work memory, which stays in the processor's cache. Nothing is compiled for a
program, so it runs at once; see `lipcore.kernels.tape`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.fast.compile import compiled
from lipcore.kernels.fast.lanes import LANES, spread
from lipcore.kernels.fast.views import lay

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

BLOCK = 64
"""Queries of a block."""
ADD, SUBTRACT, MULTIPLY, MULTIPLY_ADD, MULTIPLY_SUBTRACT, SUBTRACT_PRODUCT, NEGATE = range(7)
"""Codes of x + y, x − y, x y, x y + z, x y − z, z − x y and −x."""
FIXED = 7
"""If y is a constant, this number is added to the code."""
SUBTRACT_FROM = 2 * FIXED
"""Code of c − x, where c is a constant."""


@compiled
def run(codes: Indices, factors: Array, inputs: Array, results: Indices, memory: Array, out: Array) -> None:
    """Write the results of a program for N queries, (R, N). N is a multiple of BLOCK.

    - codes: (K, 5), operation, row of the result, rows of x, y and z; y of an operation with a constant is a place
      among the factors;
    - inputs: (I, N), the first rows of the memory; results: (R,), rows;
    - memory: (rows · BLOCK,), to work in.
    """
    width = BLOCK // LANES
    for first in range(0, inputs.shape[1], BLOCK):
        for row in range(inputs.shape[0]):
            memory[row * BLOCK : (row + 1) * BLOCK] = inputs[row, first : first + BLOCK]
        for k in range(codes.shape[0]):
            code, at = codes[k, 0], codes[k, 3]
            to = lay(memory, codes[k, 1] * BLOCK, ((width,),))[0][0]
            x = lay(memory, codes[k, 2] * BLOCK, ((width,),))[0][0]
            z = lay(memory, codes[k, 4] * BLOCK, ((width,),))[0][0]
            if code < FIXED:
                y = lay(memory, at * BLOCK, ((width,),))[0][0]
                if code == MULTIPLY_ADD:
                    for i in range(width):
                        to[i] = x[i] * y[i] + z[i]
                elif code == SUBTRACT_PRODUCT:
                    for i in range(width):
                        to[i] = z[i] - x[i] * y[i]
                elif code == MULTIPLY_SUBTRACT:
                    for i in range(width):
                        to[i] = x[i] * y[i] - z[i]
                elif code == MULTIPLY:
                    for i in range(width):
                        to[i] = x[i] * y[i]
                elif code == ADD:
                    for i in range(width):
                        to[i] = x[i] + y[i]
                elif code == SUBTRACT:
                    for i in range(width):
                        to[i] = x[i] - y[i]
                else:
                    for i in range(width):
                        to[i] = 0.0 - x[i]
            else:
                c = spread(factors[at])
                if code == FIXED + MULTIPLY_ADD:
                    for i in range(width):
                        to[i] = x[i] * c + z[i]
                elif code == FIXED + SUBTRACT_PRODUCT:
                    for i in range(width):
                        to[i] = z[i] - x[i] * c
                elif code == FIXED + MULTIPLY_SUBTRACT:
                    for i in range(width):
                        to[i] = x[i] * c - z[i]
                elif code == FIXED + MULTIPLY:
                    for i in range(width):
                        to[i] = x[i] * c
                elif code == FIXED + ADD:
                    for i in range(width):
                        to[i] = x[i] + c
                elif code == FIXED + SUBTRACT:
                    for i in range(width):
                        to[i] = x[i] - c
                else:
                    for i in range(width):
                        to[i] = c - x[i]
        for row in range(results.shape[0]):
            out[row, first : first + BLOCK] = memory[results[row] * BLOCK : (results[row] + 1) * BLOCK]

"""Arrays inside one flat array.

Passing fifty arrays to a compiled function costs ten microseconds. Cutting fifty slices costs four, and seconds of
compile time. A view here is only a pointer and a shape. `lay` alone lays out the work memory of a kernel.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from lipcore.kernels.fast.lanes import LANES, lanes

Array = NDArray[np.float64]


class Memory(threading.local):
    """One flat array for each thread: a flattened copy of each array in `fixed`, then `work` zeros."""

    def __init__(self, fixed: Sequence[Array], work: int) -> None:
        self.flat = np.concatenate([*(np.ascontiguousarray(part).reshape(-1) for part in fixed), np.zeros(work)])
        self._work = work

    def __reduce__(self) -> tuple[type[Memory], tuple[list[Array], int]]:
        """Pickle what is fixed; the threads of another process have work memory of their own."""
        return Memory, ([self.flat[: len(self.flat) - self._work]], self._work)


def _pointing(context: Any, builder: Any, kind: Any, pointer: Any, sizes: Sequence[Any], itemsize: int) -> Any:
    """Return a C-contiguous array at a pointer. It does not keep the memory alive."""
    strides = [ir.Constant(sizes[0].type, itemsize)]
    for size in sizes[:0:-1]:
        strides.insert(0, builder.mul(strides[0], size))
    array = context.make_array(kind)(context, builder)
    data, item = builder.bitcast(pointer, array.data.type), strides[-1]
    context.populate_array(array, data=data, shape=sizes, strides=strides, itemsize=item, meminfo=None)
    return array._getvalue()


def _numbers(_typing: Any, memory: Any, at: Any, shape: Any) -> tuple[Any, Callable[..., Any]]:
    kind = types.Array(types.float64, len(shape), "C")

    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        data = context.make_array(memory)(context, builder, arguments[0]).data
        sizes = cgutils.unpack_tuple(builder, arguments[2])  # type: ignore[no-untyped-call]
        return _pointing(context, builder, kind, builder.gep(data, [arguments[1]]), sizes, 8)

    return kind(memory, at, shape), generate


def _lay(_typing: Any, memory: Any, at: Any, shapes: Any) -> tuple[Any, Callable[..., Any]]:
    # Lanes may begin at any number: their natural alignment is wider
    kinds = [types.Array(lanes, len(shape), "C", aligned=False) for shape in shapes]
    result = types.Tuple([types.Tuple(kinds), types.intp])  # type: ignore[no-untyped-call]

    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        data, end = context.make_array(memory)(context, builder, arguments[0]).data, arguments[1]
        views = []
        for kind, shape in zip(kinds, cgutils.unpack_tuple(builder, arguments[2]), strict=True):  # type: ignore[no-untyped-call]
            sizes = cgutils.unpack_tuple(builder, shape)  # type: ignore[no-untyped-call]
            views.append(_pointing(context, builder, kind, builder.gep(data, [end]), sizes, 8 * LANES))
            end = builder.add(end, reduce(builder.mul, sizes, ir.Constant(end.type, LANES)))
        return context.make_tuple(builder, result, [context.make_tuple(builder, result[0], views), end])

    return result(memory, at, shapes), generate


numbers: Callable[[Array, int, tuple[int, ...]], Array] = cast(Any, intrinsic(_numbers))
"""numbers(memory, at, shape): view of a flat array from element `at` on."""
lay: Callable[[Array, int, tuple[tuple[int, ...], ...]], tuple[tuple[Array, ...], int]] = cast(Any, intrinsic(_lay))
"""lay(memory, at, shapes): consecutive views of Lanes from element `at` on, and the element after them."""

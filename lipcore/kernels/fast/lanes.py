"""Numbers of several pairs of samples, computed together: SIMD vectors in compiled code.

`Lanes` are LANES float64 numbers, one for each pair. They add, subtract and multiply like one number, with each other
and with floats. A formula for one pair therefore applies to all of them. In memory they are float64 arrays whose last
axis has LANES elements; views of `views.lay` index them by Lanes.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.datamodel import models
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, register_model
from numpy.typing import NDArray

LANES = 8
"""Pairs of samples computed together: two AVX2 registers, or one AVX-512 register."""

Lanes = float
"""Annotation of Lanes in formulas: they behave like a number."""

_VECTOR = ir.VectorType(ir.DoubleType(), LANES)


class _LanesType(types.Type):
    def __init__(self) -> None:
        super().__init__("Lanes")


lanes = _LanesType()


@register_model(_LanesType)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)  # type: ignore[no-untyped-call]


def _broadcast(builder: Any, number: Any) -> Any:
    undefined, word = ir.Constant(_VECTOR, ir.Undefined), ir.IntType(32)
    one = builder.insert_element(undefined, number, word(0))
    return builder.shuffle_vector(one, undefined, ir.Constant(ir.VectorType(word, LANES), [0] * LANES))


def _define(operation: Callable[..., Any], instruction: str) -> None:
    """Define a Python operator for Lanes on either side, or on both."""

    @infer_global(operation)  # type: ignore[no-untyped-call]
    class _Template(AbstractTemplate):
        def generic(self, arguments: Any, _keywords: Any) -> Any:
            if lanes in arguments and all(each in (lanes, types.float64) for each in arguments):
                return signature(lanes, *arguments)  # type: ignore[no-untyped-call]
            return None

    def lower(_context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        sides = zip(arguments, signature.args, strict=True)
        return getattr(builder, instruction)(*(x if kind == lanes else _broadcast(builder, x) for x, kind in sides))

    for kinds in ((lanes, lanes), (lanes, types.float64), (types.float64, lanes)):
        lower_builtin(operation, *kinds)(lower)  # type: ignore[no-untyped-call]


for _name, _instruction in (("add", "fadd"), ("sub", "fsub"), ("mul", "fmul")):
    _define(getattr(operator, _name), _instruction)
    _define(getattr(operator, f"i{_name}"), _instruction)


def _spread(_typing: Any, number: Any) -> tuple[Any, Callable[..., Any]]:
    return lanes(number), lambda _context, builder, _signature, arguments: _broadcast(builder, arguments[0])


def _widened(_typing: Any, memory: Any, at: Any) -> tuple[Any, Callable[..., Any]]:
    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        data = context.make_array(memory)(context, builder, arguments[0]).data
        narrow = ir.VectorType(ir.FloatType(), LANES)
        place = builder.bitcast(builder.gep(data, [arguments[1]]), narrow.as_pointer())
        return builder.fpext(builder.load(place, align=4), _VECTOR)

    return lanes(memory, at), generate


widened: Callable[[NDArray[np.float32], int], Lanes] = cast(Any, intrinsic(_widened))
"""widened(memory, at): Lanes of a flat float32 array from element `at` on."""
spread: Callable[[float], Lanes] = cast(Any, intrinsic(_spread))
"""Lanes that all contain the same number."""

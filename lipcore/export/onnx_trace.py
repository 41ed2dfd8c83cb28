"""A library of the array API that writes the formulas it computes as nodes of an ONNX graph.

Each array has a name in the graph, or is a constant. It also has its value for `batch` example states, which gives its
shape: the axis of this length is the batch. Constants are computed here, and are stored when a node needs them.
"""

# ruff: noqa: D102 - methods of the array API

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from lipcore.data.motion import Array


class BatchLengthError(ValueError):
    """A constant has an axis of the length of the batch: trace with another length."""


class Graph:
    """Nodes, constants and arguments of an ONNX graph, and the namespace of its arrays.

    Args:
        helper: `onnx.helper`.
        dtype: float64 or float32.
        batch: Number of example states; no other axis may have this length.
    """

    __name__ = "lipcore.export.onnx_trace"  # as a namespace of `array_api_compat`
    float64, float32 = np.dtype(np.float64), np.dtype(np.float32)

    def __init__(self, helper: Any, dtype: Any, batch: int) -> None:
        self.helper, self.dtype, self.batch = helper, np.dtype(dtype), batch
        self.nodes: list[Any] = []
        self.constants: dict[tuple[str, tuple[int, ...], bytes], str] = {}
        self._length: str | None = None

    def argument(self, name: str, value: Array) -> Traced:
        """Return an argument of the graph. value: examples, the batch first."""
        if self._length is None:
            shape = self.emit("Shape", [name])
            self._length = self.emit("Slice", [shape, self.store(np.array([0])), self.store(np.array([1]))])
        return Traced(self, np.asarray(value, self.dtype), name)

    def emit(self, kind: str, inputs: Sequence[str], **attributes: Any) -> str:
        """Add a node; return the name of its output."""
        name = f"v{len(self.nodes)}"
        self.nodes.append(self.helper.make_node(kind, list(inputs), [name], **attributes))
        return name

    def store(self, value: Array) -> str:
        """Return the name of a stored constant."""
        return self.constants.setdefault((value.dtype.str, value.shape, value.tobytes()), f"c{len(self.constants)}")

    def node(self, kind: str, value: Array, *arrays: Traced, full: bool = False, **attributes: Any) -> Traced:
        """Return the result of a node on arrays. full: the node does not broadcast."""
        if all(each.name is None for each in arrays):
            return Traced(self, value)
        return Traced(self, value, self.emit(kind, [each.placed(full) for each in arrays], **attributes))

    def shape_of(self, shape: Sequence[int]) -> str:
        """Return the name of a shape for `Reshape`."""
        if any(size % self.batch == 0 and size > self.batch for size in shape):
            raise NotImplementedError(f"shape {tuple(shape)} merges the batch with another axis")
        return self.store(np.array([-1 if size == self.batch else size for size in shape], np.int64))

    def expanded(self, name: str, shape: Sequence[int]) -> str:
        """Return the name of an array repeated for the whole batch."""
        assert self._length is not None
        parts = [self._length if size == self.batch else self.store(np.array([size])) for size in shape]
        return self.emit("Expand", [name, self.emit("Concat", parts, axis=0)])

    def asarray(self, value: Any, dtype: Any = None, **_: Any) -> Traced:
        """Return an array, or numbers as a constant."""
        if isinstance(value, Traced):
            return value
        made = np.asarray(value)
        if made.dtype != np.bool_:
            made = made.astype(self.dtype if dtype is None else dtype)
        if self.batch in made.shape:
            raise BatchLengthError(f"a constant has shape {made.shape}")
        return Traced(self, made)

    def zeros(self, shape: Any, **_: Any) -> Traced:
        return Traced(self, np.zeros(shape, self.dtype))

    def zeros_like(self, x: Traced) -> Traced:
        return Traced(self, np.zeros_like(x.value))

    def ones_like(self, x: Traced) -> Traced:
        return Traced(self, np.ones_like(x.value))

    def full_like(self, x: Traced, value: float) -> Traced:
        return Traced(self, np.full_like(x.value, value))

    def reshape(self, x: Traced, shape: Any) -> Traced:
        return x.reshape(shape)

    def permute_dims(self, x: Traced, axes: Sequence[int]) -> Traced:
        return self.node("Transpose", np.transpose(x.value, axes), x, full=True, perm=list(axes))

    def moveaxis(self, x: Traced, source: int, destination: int) -> Traced:
        axes = [axis for axis in range(x.ndim) if axis != source % x.ndim]
        axes.insert(destination % x.ndim, source % x.ndim)
        return self.permute_dims(x, axes)

    def expand_dims(self, x: Traced, axis: int = 0) -> Traced:
        return x.reshape(np.expand_dims(x.value, axis).shape)

    def concat(self, arrays: Sequence[Traced], axis: int = 0) -> Traced:
        kept = [each for each in arrays if each.value.size] or [arrays[0]]
        value = np.concatenate([each.value for each in kept], axis)
        return kept[0] if len(kept) == 1 else self.node("Concat", value, *kept, full=True, axis=axis % value.ndim)

    def stack(self, arrays: Sequence[Traced], axis: int = 0) -> Traced:
        return self.concat([self.expand_dims(each, axis) for each in arrays], axis)

    def matmul(self, one: Any, other: Any) -> Traced:
        one, other = self.asarray(one), self.asarray(other)
        return self.node("MatMul", one.value @ other.value, one, other)

    def tensordot(self, one: Traced, other: Traced, axes: int = 1) -> Traced:
        """Return Σ_m one[…, m] other[m, …]. one: (m,) or (k, m)."""
        assert axes == 1
        if one.ndim == 1:
            return self.tensordot(one[None], other)[0]
        middle = tuple(range(1, other.ndim - 1))
        if not middle:
            return self.matmul(one, other)
        last = other.ndim - 1
        made = self.matmul(one, self.permute_dims(other, (*middle, 0, last)))
        return self.permute_dims(made, (last - 1, *(axis - 1 for axis in middle), last))

    def take(self, x: Traced, indices: Any, axis: int = 0) -> Traced:
        if isinstance(indices, Traced):
            indices = indices.value
        places = Traced(self, np.asarray(indices, np.int64))
        return self.node("Gather", np.take(x.value, places.value, axis), x, places, full=True, axis=axis)

    def square(self, x: Traced) -> Traced:
        return x * x

    def sum(self, x: Traced, axis: Any = None, keepdims: bool = False) -> Traced:
        return self._reduced("ReduceSum", np.sum, x, axis, keepdims)

    def mean(self, x: Traced, axis: Any = None, keepdims: bool = False) -> Traced:
        return self._reduced("ReduceMean", np.mean, x, axis, keepdims)

    def max(self, x: Traced, axis: Any = None, keepdims: bool = False) -> Traced:
        return self._reduced("ReduceMax", np.max, x, axis, keepdims)

    def _reduced(self, kind: str, compute: Callable[..., Any], x: Traced, axis: Any, keepdims: bool) -> Traced:
        value = compute(x.value, axis=axis, keepdims=keepdims)
        axes = range(x.ndim) if axis is None else [axis] if isinstance(axis, int) else axis
        given = Traced(self, np.array([each % x.ndim for each in axes], np.int64))
        return self.node(kind, value, x, given, full=True, keepdims=int(keepdims))

    def clip(self, x: Traced, low: float | None, high: float | None) -> Traced:
        """Return x within bounds; None for no bound."""
        x = x if low is None else self.maximum(x, low)
        return x if high is None else self.minimum(x, high)

    def maximum(self, one: Any, other: Any) -> Traced:
        return self.pair("Max", np.maximum, one, other)

    def minimum(self, one: Any, other: Any) -> Traced:
        return self.pair("Min", np.minimum, one, other)

    def where(self, condition: Traced, one: Any, other: Any) -> Traced:
        one, other = self.asarray(one), self.asarray(other)
        return self.node("Where", np.where(condition.value, one.value, other.value), condition, one, other)

    def pair(self, kind: str, compute: Callable[..., Any], one: Any, other: Any) -> Traced:
        """Return the result of a node of two arrays that broadcast. Sums and products with zero need no node."""
        one, other = self.asarray(one), self.asarray(other)
        value = compute(one.value, other.value)
        rest: Traced
        for each, rest in ((one, other), (other, one)):
            if each.name is None and not each.value.any():
                if kind == "Mul":
                    return Traced(self, np.zeros_like(value))
                if rest.shape == value.shape and (kind == "Add" or (kind == "Sub" and each is other)):
                    return rest
        return self.node(kind, value, one, other)


UNARY = {"exp": "Exp", "sin": "Sin", "cos": "Cos", "tanh": "Tanh", "sqrt": "Sqrt", "abs": "Abs", "log": "Log"}


def _unary(name: str, kind: str) -> Callable[[Graph, Traced], Traced]:
    return lambda graph, x: graph.node(kind, getattr(np, name)(x.value), x)


for _name, _kind in UNARY.items():
    setattr(Graph, _name, _unary(_name, _kind))


class Traced:
    """An array of a graph. name: None for a constant; value: for the example states."""

    __array_ufunc__ = None

    def __init__(self, graph: Graph, value: Any, name: str | None = None) -> None:
        self.graph, self.value, self.name = graph, np.asarray(value), name

    def __array_namespace__(self, api_version: str | None = None) -> Graph:
        return self.graph

    @property
    def shape(self) -> tuple[int, ...]:
        return self.value.shape

    @property
    def ndim(self) -> int:
        return self.value.ndim

    @property
    def dtype(self) -> Any:
        return self.value.dtype

    @property
    def device(self) -> str:
        return "cpu"

    @property
    def T(self) -> Traced:  # noqa: N802 - of the array API
        return self.graph.permute_dims(self, tuple(reversed(range(self.ndim))))

    @property
    def mT(self) -> Traced:  # noqa: N802 - of the array API
        return self.graph.permute_dims(self, (*range(self.ndim - 2), self.ndim - 1, self.ndim - 2))

    def placed(self, full: bool) -> str:
        """Return the name in the graph; a constant of the whole batch is stored once, or expanded if `full`."""
        if self.name is not None:
            return self.name
        axes = [axis for axis, size in enumerate(self.shape) if size == self.graph.batch]
        one = self.value
        for axis in axes:
            one = one.take([0], axis)
        stored = self.graph.store(np.ascontiguousarray(one))
        return self.graph.expanded(stored, self.shape) if axes and full else stored

    def reshape(self, *shape: Any) -> Traced:
        """Return the same numbers in another shape."""
        value = self.value.reshape(*shape)
        if value.shape == self.shape:
            return self
        if self.name is None:
            return Traced(self.graph, value)
        target = self.graph.shape_of(value.shape)
        return Traced(self.graph, value, self.graph.emit("Reshape", [self.name, target]))

    def sum(self, axis: Any = None) -> Traced:
        return self.graph.sum(self, axis)

    def mean(self, axis: Any = None) -> Traced:
        return self.graph.mean(self, axis)

    def __len__(self) -> int:
        return len(self.value)

    def __iter__(self) -> Iterator[Traced]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, key: Any) -> Traced:
        value = self.value[key]
        if self.name is None:
            return Traced(self.graph, value)
        keys, given, graph = list(key if isinstance(key, tuple) else (key,)), self.name, self.graph
        if Ellipsis in keys:
            place, missing = keys.index(Ellipsis), self.ndim - sum(each is not None for each in keys) + 1
            keys[place : place + 1] = [slice(None)] * missing
        parts, cuts = [slice(None)] * self.ndim, []
        for axis, each in enumerate(each for each in keys if each is not None):
            size = self.shape[axis]
            first, end, step = (each % size, each % size + 1, 1) if isinstance(each, int) else each.indices(size)
            assert step > 0
            if (first, end, step) != (0, size, 1):
                parts[axis] = slice(first, end, step)
                cuts.append((first, end, axis, step))
        if cuts:
            bounds = (graph.store(np.array(each, np.int64)) for each in zip(*cuts, strict=True))
            given = graph.emit("Slice", [given, *bounds])
        return Traced(graph, self.value[tuple(parts)], given).reshape(value.shape)

    def __add__(self, other: Any) -> Traced:
        return self.graph.pair("Add", operator.add, self, other)

    def __mul__(self, other: Any) -> Traced:
        return self.graph.pair("Mul", operator.mul, self, other)

    __radd__, __rmul__ = __add__, __mul__

    def __sub__(self, other: Any) -> Traced:
        return self.graph.pair("Sub", operator.sub, self, other)

    def __rsub__(self, other: Any) -> Traced:
        return self.graph.pair("Sub", operator.sub, other, self)

    def __truediv__(self, other: Any) -> Traced:
        return self.graph.pair("Div", operator.truediv, self, other)

    def __rtruediv__(self, other: Any) -> Traced:
        return self.graph.pair("Div", operator.truediv, other, self)

    def __pow__(self, power: Any) -> Traced:
        return (
            self * self if isinstance(power, int) and power == 2 else self.graph.pair("Pow", operator.pow, self, power)
        )

    def __neg__(self) -> Traced:
        return self.graph.node("Neg", -self.value, self)

    def __matmul__(self, other: Any) -> Traced:
        return self.graph.matmul(self, other)

    def __le__(self, other: Any) -> Traced:
        return self.graph.pair("LessOrEqual", operator.le, self, other)

    def __lt__(self, other: Any) -> Traced:
        return self.graph.pair("Less", operator.lt, self, other)

    def __gt__(self, other: Any) -> Traced:
        return self.graph.pair("Greater", operator.gt, self, other)

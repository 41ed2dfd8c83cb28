"""Formulas as programs of single operations: run a formula once on `Number` objects, and read what it computed.

A `Number` calculates like a float, alone or in a NumPy array of objects. So a formula in the array API accepts it.
Constants are computed at once. Sums with zero, products with zero or one, and double signs are removed. Equal
operations become one. `Program` contains the operations that its results need, each after its arguments.

Example:
    >>> graph = Graph()
    >>> x, y = graph.inputs(2)
    >>> Program.of([(x + y) * (y + x) + 0.0 * x]).operations
    (Operation(name='+', arguments=(0, 1)), Operation(name='*', arguments=(2, 2)))

"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

INPUT, CONSTANT = "input", "constant"
UNARY = ("negative", "sin", "cos", "tanh", "exp", "sqrt", "fabs")
"""Operations with one argument; the others are + - * /, with two."""


@dataclass(frozen=True)
class Operation:
    """An operation: arguments are places of a program's inputs, then constants, then operations."""

    name: str
    arguments: tuple[int, ...]


class Graph:
    """The operations of a formula, each once."""

    def __init__(self) -> None:
        self.nodes: list[tuple[Any, ...]] = []
        self._places: dict[tuple[Any, ...], int] = {}
        self._inputs = 0

    def inputs(self, count: int) -> list[Number]:
        """Add inputs to the program and return them."""
        first, self._inputs = self._inputs, self._inputs + count
        return [self.number(INPUT, place) for place in range(first, first + count)]

    def number(self, name: str, *arguments: Any) -> Number:
        """Return the number of a node: an operation on nodes, an input with its place, or a constant with its value."""
        node = (name, *arguments)
        place = self._places.setdefault(node, len(self.nodes))
        if place == len(self.nodes):
            self.nodes.append(node)
        return Number(self, place)

    def __len__(self) -> int:
        return self._inputs


class Number:
    """A number that an operation will compute."""

    __slots__ = ("graph", "place")

    def __init__(self, graph: Graph, place: int) -> None:
        self.graph, self.place = graph, place

    def __add__(self, other: Any) -> Number:
        return _sum(self, _of(self.graph, other))

    def __radd__(self, other: Any) -> Number:
        return _sum(_of(self.graph, other), self)

    def __sub__(self, other: Any) -> Number:
        return _difference(self, _of(self.graph, other))

    def __rsub__(self, other: Any) -> Number:
        return _difference(_of(self.graph, other), self)

    def __mul__(self, other: Any) -> Number:
        return _product(self, _of(self.graph, other))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Number:
        return _ratio(self, _of(self.graph, other))

    def __rtruediv__(self, other: Any) -> Number:
        return _ratio(_of(self.graph, other), self)

    def __neg__(self) -> Number:
        name, *arguments = self.node
        return Number(self.graph, arguments[0]) if name == "negative" else self._unary("negative")

    def __abs__(self) -> Number:
        return self._unary("fabs")

    def sin(self) -> Number:
        """Return the sine. NumPy calls this method, and those below, for arrays of objects."""
        return self._unary("sin")

    def cos(self) -> Number:
        """Return the cosine."""
        return self._unary("cos")

    def tanh(self) -> Number:
        """Return the hyperbolic tangent."""
        return self._unary("tanh")

    def exp(self) -> Number:
        """Return the exponential."""
        return self._unary("exp")

    def sqrt(self) -> Number:
        """Return the square root."""
        return self._unary("sqrt")

    @property
    def node(self) -> tuple[Any, ...]:
        """Name and arguments of the operation."""
        return self.graph.nodes[self.place]

    @property
    def constant(self) -> float | None:
        """The value of a constant, or None."""
        name, *arguments = self.node
        return arguments[0] if name == CONSTANT else None

    def _unary(self, name: str) -> Number:
        if self.constant is None:
            return self.graph.number(name, self.place)
        return _of(self.graph, -self.constant if name == "negative" else getattr(math, name)(self.constant))


def _of(graph: Graph, value: Any) -> Number:
    return value if isinstance(value, Number) else graph.number(CONSTANT, float(value) + 0.0)  # not −0


def _negated(number: Number) -> Number | None:
    """Return x if the number is −x, else None."""
    name, *arguments = number.node
    return Number(number.graph, arguments[0]) if name == "negative" else None


def _sum(one: Number, other: Number) -> Number:
    if one.constant is not None and other.constant is not None:
        return _of(one.graph, one.constant + other.constant)
    if one.constant == 0.0 or other.constant == 0.0:
        return other if one.constant == 0.0 else one
    if (negated := _negated(other)) is not None:
        return _difference(one, negated)
    if (negated := _negated(one)) is not None:
        return _difference(other, negated)
    return one.graph.number("+", *sorted((one.place, other.place)))


def _difference(one: Number, other: Number) -> Number:
    if one.constant is not None and other.constant is not None:
        return _of(one.graph, one.constant - other.constant)
    if one.constant == 0.0 or other.constant == 0.0:
        return -other if one.constant == 0.0 else one
    if (negated := _negated(other)) is not None:
        return _sum(one, negated)
    if (negated := _negated(one)) is not None:
        return -_sum(negated, other)
    return one.graph.number("-", one.place, other.place)


def _product(one: Number, other: Number) -> Number:
    if other.constant is not None:
        one, other = other, one
    if (factor := one.constant) is not None:
        if other.constant is not None:
            return _of(one.graph, factor * other.constant)
        if factor in (0.0, 1.0):
            return other if factor else one
        if factor < 0.0:  # x a and −x a are one operation
            return -_product(_of(one.graph, -factor), other)
    for each, left in ((one, other), (other, one)):
        if (negated := _negated(each)) is not None:
            return -_product(negated, left)
    return one.graph.number("*", *sorted((one.place, other.place)))


def _ratio(one: Number, other: Number) -> Number:
    if other.constant is not None:
        return _product(one, _of(one.graph, 1.0 / other.constant))
    return one.graph.number("/", one.place, other.place)


def jacobian(results: Sequence[Number], inputs: Sequence[Number]) -> list[list[Number]]:
    """Return the derivative of each result with respect to each input, by adjoints from the result back.

    Raise ValueError if a result depends on an input by operations other than sums, differences, products and signs.
    """
    graph, active = inputs[0].graph, {each.place for each in inputs}
    for place, (name, *arguments) in enumerate(graph.nodes[: max(each.place for each in results) + 1]):
        if name not in (INPUT, CONSTANT) and not active.isdisjoint(arguments):
            active.add(place)
    rows = []
    for result in results:
        adjoints = {result.place: _of(graph, 1.0)}
        for place in range(result.place, -1, -1):
            if place not in adjoints or place not in active:
                continue
            for argument, share in _shares(Number(graph, place), adjoints[place]):
                before = adjoints.get(argument)
                adjoints[argument] = share if before is None else before + share
        rows.append([adjoints.get(each.place, _of(graph, 0.0)) for each in inputs])
    return rows


def _shares(number: Number, adjoint: Number) -> list[tuple[int, Number]]:
    """Return the shares that the places of an operation's arguments have in its adjoint."""
    name, *arguments = number.node
    one, other = (arguments * 2)[:2]
    match name:
        case "input":
            return []
        case "negative":
            return [(one, -adjoint)]
        case "+":
            return [(one, adjoint), (other, adjoint)]
        case "-":
            return [(one, adjoint), (other, -adjoint)]
        case "*":
            return [(one, adjoint * Number(number.graph, other)), (other, adjoint * Number(number.graph, one))]
    raise ValueError(f"the operation is {name!r}, expected +, -, * or negative")


@dataclass(frozen=True)
class Program:
    """Operations in the order in which they run. Places count inputs first, then constants, then operations."""

    inputs: int
    constants: tuple[float, ...]
    operations: tuple[Operation, ...]
    results: tuple[int, ...]
    """Places of the results."""

    @classmethod
    def of(cls, results: Sequence[Number]) -> Program:
        """Return the program of some results of one graph."""
        graph = results[0].graph
        needed, left = set[int](), [each.place for each in results]
        while left:
            place = left.pop()
            if place not in needed:
                needed.add(place)
                name, *arguments = graph.nodes[place]
                left.extend(arguments if name not in (INPUT, CONSTANT) else ())
        order = sorted(needed)
        constants = [each for each in order if graph.nodes[each][0] == CONSTANT]
        moving = [each for each in order if graph.nodes[each][0] not in (INPUT, CONSTANT)]
        places = {each: graph.nodes[each][1] for each in order if graph.nodes[each][0] == INPUT}
        places |= {each: len(graph) + place for place, each in enumerate([*constants, *moving])}
        operations = [
            Operation(name, tuple(places[each] for each in arguments))
            for name, *arguments in (graph.nodes[each] for each in moving)
        ]
        values = tuple(graph.nodes[each][1] for each in constants)
        return cls(len(graph), values, tuple(operations), tuple(places[each.place] for each in results))

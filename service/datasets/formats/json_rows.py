"""Objects of JSON, one a sample, as columns of numbers: what is nested becomes `a.b` and `name[0]`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import islice
from typing import Any

import msgspec
import numpy as np

from lipcore.data.samples import Array
from service.datasets.formats.blocks import block_rows, checked_names, left_out
from service.datasets.formats.json_shape import Node, Shape, name_of
from service.foundation.errors import InvalidDataError, invalid_data
from service.foundation.settings import Settings

SAMPLE_ROWS = 1000
"""Rows that tell which columns there are."""


class Rows:
    """Rows that are objects, as blocks of numbers; NaN where one is missing or null.

    names: of the columns, those that hold numbers in the first rows; facts: what is left out.
    """

    def __init__(self, rows: Iterator[Any], settings: Settings) -> None:
        self._rest = rows
        self._first = list(islice(rows, SAMPLE_ROWS))
        for number, row in enumerate(self._first, start=1):
            _check(row, number)
        shape = Shape(self._first, 2 * settings.max_columns)
        numbers, others = shape.columns()
        self.names = checked_names(map(name_of, numbers), settings)
        self.facts = left_out([name_of(path) for path in others], "they hold no numbers, or lists of different lengths")
        self._plan = shape.plan(numbers)

    def blocks(self) -> Iterator[Array]:
        """float64 (rows, columns)."""
        most, width = block_rows(len(self.names)), len(self.names)
        filled, block = 0, np.full((most, width), np.nan)
        for row, each in enumerate(self._all(), start=1):
            _check(each, row)
            values = [np.nan] * width
            self._fill(self._plan, each, values, row)
            block[filled] = values
            filled += 1
            if filled == most:
                yield block
                filled, block = 0, np.full((most, width), np.nan)
        if filled:
            yield block[:filled]

    def _all(self) -> Iterator[Any]:
        yield from self._first
        self._first = []
        yield from self._rest

    def _fill(self, node: Node, value: Any, values: list[float], row: int) -> None:
        if isinstance(node, int):
            if type(value) is float:
                values[node] = value
            elif value is not None:
                values[node] = self._number(node, value, row)
        elif value is None:
            return
        elif isinstance(node, dict):
            if type(value) is not dict:
                raise self._other(node, value, "an object", row)
            for key, part in node.items():
                if part is not None:
                    self._fill(part, value.get(key), values, row)
        elif value != []:  # an empty list is a missing value
            if type(value) is not list:
                raise self._other(node, value, "a list", row)
            if len(value) != len(node):
                raise self._other(node, f"{len(value)} values", f"{len(node)} values", row)
            for part, item in zip(node, value, strict=True):
                if part is not None:
                    self._fill(part, item, values, row)

    def _number(self, index: int, value: Any, row: int) -> float:
        if type(value) is not int:
            raise invalid_data(f"{self.names[index]}, row {row}", value, "a number")
        try:
            return float(value)
        except OverflowError:
            return np.inf

    def _other(self, node: Any, value: Any, expected: str, row: int) -> InvalidDataError:
        while not isinstance(node, int):  # to the first column in there, as it has a name
            node = next(part for part in (node.values() if isinstance(node, dict) else node) if part is not None)
        return invalid_data(f"{self.names[node]}, row {row}", value, f"{expected} as in the first rows")


def decode(text: bytes) -> Any:
    """JSON, with NaN and Infinity as Python's writer puts them; raise ValueError."""
    try:
        return msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError):
        try:
            return json.loads(text)
        except RecursionError:
            raise ValueError("nested too deep") from None


def _check(row: Any, number: int) -> None:
    if type(row) is not dict:
        raise invalid_data(f"row {number}", row, "an object with a name for every value")

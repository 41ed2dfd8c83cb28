"""Rows of numbers in JSON as arrays, with errors that name the place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.foundation.errors import invalid_request


def to_array(name: str, value: Any, read: Callable[[str, list[Any]], list[float]]) -> NDArray[np.float64]:
    """Numbers (n,) or rows of numbers (N, n) as an array; raise InvalidRequestError naming what is wrong.

    read: takes the name and the numbers of one row, and raises InvalidRequestError for what is none.
    """
    if not isinstance(value, list) or not value:
        raise invalid_request(name, value, "a list of numbers, or a list of such lists")
    if not isinstance(value[0], list):
        return np.array(read(name, value))
    width = len(value[0])
    rows = []
    for index, row in enumerate(value):
        if not isinstance(row, list) or len(row) != width:
            raise invalid_request(f"{name}[{index}]", row, f"a list of {width} numbers, as {name}[0] has")
        rows.append(read(f"{name}[{index}]", row))
    return np.array(rows).reshape(len(rows), width)

"""From the API's JSON to arrays and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def array(values: Any) -> Array:
    """Numbers as an array; null as NaN."""
    return np.array(values, np.float64)


def plain(value: Any) -> Any:
    """What JSON can say of a result: arrays as lists, NaN as null; fields that are None are left out."""
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, float):
        return None if np.isnan(value) else value
    if is_dataclass(value) and not isinstance(value, type):
        given = {each.name: getattr(value, each.name) for each in fields(value)}
        return {name: plain(each) for name, each in given.items() if each is not None}
    if isinstance(value, Mapping):
        return {name: plain(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    return value


class Plain:
    """Of dataclasses: what JSON can say of them."""

    def as_dict(self) -> dict[str, Any]:
        """The result as the API tells it: lists for arrays, None for NaN; fields that are None are left out."""
        found: dict[str, Any] = plain(self)
        return found

"""Checks of a file from a stranger: each raises ValueError that names the entry, its value and what was expected."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any

from lipcore.files.strict_json import quote

LARGEST = 1e12
"""No motion, torque or parameter in SI units is larger."""
LARGEST_SQUARE = LARGEST**2
"""The same of what is a torque squared: covariances and jitter."""
MAX_NAME = 100


def wrong(name: str, value: object, expected: str) -> ValueError:
    """The error of an entry with a value that is not what was expected."""
    return ValueError(f"{name} is {quote(value)}, expected {expected}")


def check_keys(name: str, value: object, required: Collection[str], optional: Collection[str] = ()) -> None:
    """An object with all the required entries, and no others but optional ones."""
    if not isinstance(value, dict):
        raise wrong(name, value, "an object")
    for key in required:
        if key not in value:
            raise ValueError(f"{name} lacks {key}")
    for key in value:
        if key not in required and key not in optional:
            raise ValueError(f"{name} has the entry {quote(key)}, which this release does not know")


def check_text(name: str, value: object, most: int = MAX_NAME) -> None:
    """1 to `most` printable characters."""
    if not isinstance(value, str) or not 1 <= len(value) <= most or not value.isprintable():
        raise wrong(name, value, f"1 to {most} printable characters")


def check_choice(name: str, value: object, known: Sequence[str]) -> None:
    """One of the known words."""
    if value not in known:
        raise wrong(name, value, f"one of {', '.join(known)}")


def check_list(name: str, value: object, n: int) -> list[Any]:
    """A list of n, which is returned."""
    if not isinstance(value, list) or len(value) != n:
        raise wrong(name, value, f"a list of {n}")
    return value


def check_numbers(
    name: str, value: object, shape: Sequence[int] = (), low: float = -math.inf, high: float = math.inf
) -> None:
    """A number from `low` to `high`, or lists of them, one in another, of this shape."""
    if shape:
        for index, each in enumerate(check_list(name, value, shape[0])):
            check_numbers(f"{name}[{index}]", each, shape[1:], low, high)
    elif not isinstance(value, int | float) or isinstance(value, bool) or not low <= value <= high:
        bounds = "" if (low, high) == (-math.inf, math.inf) else f" from {low:g} to {high:g}"
        raise wrong(name, value, f"a number{bounds}")

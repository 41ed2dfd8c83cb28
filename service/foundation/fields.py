"""Validators and schemas of fields that several rooms share: names for people, lists of numbers, uploads."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Sequence
from contextlib import suppress
from math import isfinite, nan
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, ValidationInfo

from service.foundation.errors import InvalidRequestError, invalid_request

MAX_NAME_CHARS, MAX_NAMES = 200, 1000
"""Max characters of a name; and max entries of a list of names, or of a list with one number per joint."""


def check_name(field: str, name: str) -> str:
    """Return a name; raise InvalidRequestError if it is empty, too long or contains invisible characters.

    Control, bidirectional and zero-width characters make one name look like another, and break logs and terminals.
    """
    if not name.strip() or len(name) > MAX_NAME_CHARS or not name.isprintable():
        raise invalid_request(field, name, f"1 to {MAX_NAME_CHARS} printable characters")
    return name


def _checked(name: str, info: ValidationInfo) -> str:
    return check_name(info.field_name or "name", name)


NameForPeople = Annotated[str, Field(min_length=1, max_length=MAX_NAME_CHARS), AfterValidator(_checked)]


def numbers(name: str, row: list[Any], nullable: bool = False) -> list[float]:
    """Return the finite numbers of a JSON list; raise InvalidRequestError.

    nullable: accept any numbers, and read null as NaN.
    """
    if set(map(type, row)) <= {int, float}:
        with suppress(OverflowError):
            values = list(map(float, row))
            if nullable or all(map(isfinite, values)):
                return values
    out = []
    for index, number in enumerate(row):
        value, expected = None, "a number, or null where none was measured" if nullable else "a finite number"
        if type(number) in (int, float):
            try:
                value = float(number)
            except OverflowError:
                expected = "a number of at most 1e308" if nullable else expected
        elif number is None and nullable:
            value = nan
        if value is None or not (nullable or isfinite(value)):
            raise invalid_request(f"{name}[{index}]", number, expected)
        out.append(value)
    return out


ToArray = Callable[[Any, ValidationInfo], NDArray[np.float64]]


def rows_of_numbers(nullable: bool = False, within: str = "") -> ToArray:
    """Return a validator that turns numbers (n,) or rows of numbers (N, n) into an array.

    nullable: see `numbers`. within: path to the field in errors, such as `history.`.
    """
    return lambda value, info: _to_array(f"{within}{info.field_name}", value, nullable)


def list_of_numbers(nullable: bool = False, within: str = "") -> ToArray:
    """Return a validator that turns one number or numbers (N,) into an array (N,); see `rows_of_numbers`."""

    def validate(value: Any, info: ValidationInfo) -> NDArray[np.float64]:
        return np.array(numbers(f"{within}{info.field_name}", value if isinstance(value, list) else [value], nullable))

    return validate


def check_unique(names: list[Any]) -> list[Any]:
    """Return the names of components; raise InvalidRequestError if one is repeated."""
    if (index := first_repeat(names)) is not None:
        raise invalid_request(f"components[{index}]", names[index], "each component once")
    return names


def first_repeat(values: Iterable[Hashable]) -> int | None:
    """Return the index of the first repeated value in linear time, None if there is none."""
    seen = set()
    for index, value in enumerate(values):
        if value in seen:
            return index
        seen.add(value)
    return None


def finite(values: Sequence[float] | NDArray[np.float64]) -> list[float | None]:
    """Return numbers (n,) for JSON, with null for each number that is not finite."""
    return [float(value) if isfinite(value) else None for value in values]


def _to_array(name: str, value: Any, nullable: bool) -> NDArray[np.float64]:
    if not isinstance(value, list) or not value:
        raise invalid_request(name, value, "a list of numbers, or a list of such lists")
    if not isinstance(value[0], list):
        return np.array(numbers(name, value, nullable))
    width = len(value[0])
    if set(map(type, value)) == {list} and set(map(len, value)) == {width}:
        with suppress(InvalidRequestError):  # the loop below names its place
            flat = [number for row in value for number in row]
            return np.array(numbers(name, flat, nullable)).reshape(len(value), width)
    rows = []
    for index, row in enumerate(value):
        if not isinstance(row, list) or len(row) != width:
            raise invalid_request(f"{name}[{index}]", row, f"a list of {width} numbers, the length of {name}[0]")
        rows.append(numbers(f"{name}[{index}]", row, nullable))
    return np.array(rows).reshape(len(rows), width)


BINARY: dict[str, Any] = {"type": "string", "format": "binary"}


def upload_body(description: str, content: dict[str, Any], file: str) -> dict[str, Any]:
    """Return the OpenAPI description of an upload: the body is the file, or a form with one file."""
    form = {"type": "object", "required": ["file"], "properties": {"file": {**BINARY, "description": file}}}
    every = {**content, "multipart/form-data": {"schema": form}}
    return {"requestBody": {"required": True, "description": description, "content": every}}

"""Results with arrays: conversion from and to the API's JSON, and tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from html import escape
from typing import Any, TypeVar, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

from lipserve.call import Answer, decoder

Array = NDArray[np.float64]
Result = TypeVar("Result")


def array(values: Any) -> Array:
    """Return numbers as an array, with NaN for null."""
    return np.array(values, np.float64)


def reading(kind: type[Result]) -> Callable[[Answer], Result]:
    """Return a function that reads an answer as a dataclass: lists become arrays, null becomes NaN.

    Fields that the dataclass does not have are ignored.
    """
    decode = decoder(kind, _numbers).decode
    return lambda answer: decode(answer.body)


def _numbers(kind: Any, values: Any) -> Any:
    """Convert the values of a field annotated `NDArray[…]` to an array."""
    (number,) = get_args(get_args(kind)[1])
    return np.array(values, number)


def shape_arrays(result: Any, shape: tuple[int, ...], *names: str) -> None:
    """Reshape array fields of a new result: JSON does not keep the shape of an array without rows."""
    for name in names:
        object.__setattr__(result, name, getattr(result, name).reshape(shape))


def plain(value: Any) -> Any:
    """Convert a result to JSON types: arrays to lists, NaN to None; fields that are None are omitted."""
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, float):
        return None if np.isnan(value) else value
    if isinstance(value, msgspec.Struct):
        return msgspec.to_builtins(value)
    if is_dataclass(value) and not isinstance(value, type):
        given = {each.name: getattr(value, each.name) for each in fields(value)}
        return {name: plain(each) for name, each in given.items() if each is not None}
    if isinstance(value, Mapping):
        return {name: plain(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    return value


class Plain:
    """Base of result dataclasses, with conversion to JSON types."""

    def as_dict(self) -> dict[str, Any]:
        """Return the result as in the API: lists for arrays, None for NaN; fields that are None are omitted."""
        document: dict[str, Any] = plain(self)
        return document


def figure(value: float, form: str) -> str:
    """Format a number, `-` for NaN."""
    return "-" if np.isnan(value) else format(value, form).replace("%", " %")


def text_table(title: str, columns: Mapping[str, Sequence[str]]) -> str:
    """Return a table as text, with the first column left-aligned and the others right-aligned."""
    widths = {name: max(len(name), *map(len, cells), 0) for name, cells in columns.items()}
    rows = [tuple(columns), *zip(*columns.values(), strict=True)]
    lines = [
        "  ".join(
            cell.ljust(width) if at == 0 else cell.rjust(width)
            for at, (cell, width) in enumerate(zip(row, widths.values(), strict=True))
        ).rstrip()
        for row in rows
    ]
    return "\n".join([title, *lines])


def html_table(title: str, columns: Mapping[str, Sequence[str]]) -> str:
    """Return a table as HTML, with its texts escaped."""
    head = "".join(f"<th>{escape(name)}</th>" for name in columns)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>"
        for row in zip(*columns.values(), strict=True)
    )
    return f"<table><caption>{escape(title)}</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"

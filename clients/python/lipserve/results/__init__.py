"""Results whose numbers are arrays: from the API's JSON and back, and as plain tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from html import escape
from typing import Any, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from lipserve.call import Answer, decoder

Array = NDArray[np.float64]
Result = TypeVar("Result")


def array(values: Any) -> Array:
    """Numbers as an array; null as NaN."""
    return np.array(values, np.float64)


def reading(kind: type[Result]) -> Callable[[Answer], Result]:
    """A function that reads an answer as a dataclass of results: lists as arrays, null in them as NaN. What the
    dataclass does not name is left out."""
    decode = decoder(kind, _numbers).decode
    return lambda answer: decode(answer.body)


def _numbers(kind: Any, values: Any) -> Any:
    """Values of a field that is annotated `NDArray[…]`, as such an array."""
    (number,) = get_args(get_args(kind)[1])
    return np.array(values, number)


def shape_arrays(result: Any, shape: tuple[int, ...], *names: str) -> None:
    """Give fields of a result that has just been read their shape: JSON does not tell that of an array without rows."""
    for name in names:
        object.__setattr__(result, name, getattr(result, name).reshape(shape))


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
        document: dict[str, Any] = plain(self)
        return document


def figure(value: float, form: str) -> str:
    """A number in a form, `-` where there is none."""
    return "-" if np.isnan(value) else format(value, form).replace("%", " %")


def text_table(title: str, columns: Mapping[str, Sequence[str]]) -> str:
    """Lines of a table, the first column to the left and the others to the right."""
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
    """The table as HTML; what it shows is escaped."""
    head = "".join(f"<th>{escape(name)}</th>" for name in columns)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>"
        for row in zip(*columns.values(), strict=True)
    )
    return f"<table><caption>{escape(title)}</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"

"""Plain tables, for `print` and notebooks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np


def figure(value: float, form: str) -> str:
    """A number in a form, `-` where there is none."""
    return "-" if np.isnan(value) else format(value, form)


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

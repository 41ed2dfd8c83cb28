"""Reading CSV: a header line with the canonical column names, then numbers."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np

from service.datasets.columns import Columns, order_columns, too_many, whole_numbers
from service.errors import InvalidDataError, invalid_data
from service.settings import Settings

HEADER_BYTES = 64 * 1024
_BAD_NUMBER = re.compile(r"could not convert string '?(.*?)'? to float64 at row (\d+), column (\d+)", re.DOTALL)
_BAD_WIDTH = re.compile(r"number of columns changed from (\d+) to (\d+) at row (\d+)")


def read_csv(path: Path, settings: Settings) -> Columns:
    """Read a CSV file; raise InvalidDataError naming row and column of what is wrong."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            header = next(csv.reader([file.readline(HEADER_BYTES)]), [])
            names = [name.strip() for name in header]
            if not any(names):
                raise invalid_data("header", "empty", "column names in the first line")
            order = order_columns(names)
            table = np.loadtxt(
                file, delimiter=",", ndmin=2, comments=None, quotechar='"', max_rows=settings.max_samples + 1
            )
    except UnicodeDecodeError as error:
        raise invalid_data("file", f"byte {error.object[error.start]:#04x}", "text in UTF-8") from None
    except csv.Error as error:
        raise invalid_data("header", str(error), "column names separated by commas") from None
    except ValueError as error:
        raise _explain(str(error), names) from None
    if len(table) > settings.max_samples:
        raise too_many(len(table), settings.max_samples)
    if len(table) == 0:
        raise invalid_data("rows", 0, f"at least {settings.min_samples} samples below the header")
    if table.shape[1] != len(names):
        raise invalid_data("row 1", f"{table.shape[1]} values", f"{len(names)} values, as the header has columns")

    parts = {name: np.ascontiguousarray(table[:, indices]) for name, indices in order.items()}
    return Columns(
        q=parts["q"],
        tau=parts["tau"],
        dq=parts.get("dq"),
        ddq=parts.get("ddq"),
        t=parts["t"][:, 0] if "t" in parts else None,
        episode=whole_numbers(parts["episode"][:, 0]) if "episode" in parts else None,
    )


def _explain(message: str, names: list[str]) -> InvalidDataError:
    if match := _BAD_NUMBER.search(message):
        text, row, column = match[1], int(match[2]), int(match[3])
        name = names[column - 1] if 0 < column <= len(names) else f"column {column}"
        return invalid_data(f"{name}, row {row + 1}", text or "empty", "a number")
    if match := _BAD_WIDTH.search(message):
        return invalid_data(f"row {int(match[3])}", f"{match[2]} values", f"{match[1]} values as in the rows before")
    return invalid_data("file", message, "numbers separated by commas")

"""Reading Excel workbooks (.xlsx): a sheet is read as text is, with its units, dates and lines above the names."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import datetime, time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import openpyxl

from service.datasets.formats.csv import open_csv
from service.datasets.formats.table import MAX_COLUMNS, Table, first_line, unreadable
from service.datasets.formats.zips import ERRORS, check_unpacked_size, open_zip
from service.datasets.options import ReadOptions
from service.foundation.errors import invalid_data
from service.foundation.settings import Settings

EXPECTED = "a complete Excel workbook"


@contextmanager
def open_xlsx(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open a sheet of a workbook as a table: that of `options.topic`, by default the first with several rows.

    Formulas have their stored values. Raise InvalidDataError or TooLargeError.
    """
    with open_zip(path, EXPECTED) as archive:
        check_unpacked_size(archive.infolist(), settings)
    with TemporaryDirectory(dir=path.parent) as folder:
        target = Path(folder) / "sheet.csv"
        try:
            with path.open("rb") as file:
                book = openpyxl.load_workbook(file, read_only=True, data_only=True, keep_links=False)
                with closing(book):
                    name = _write_sheet(book, options.topic, target)
        except (*ERRORS, LookupError, TypeError, AttributeError, SyntaxError) as error:  # of damaged XML
            raise unreadable("file", first_line(error), EXPECTED) from None
        with open_csv(target, options, settings) as table:
            table.facts.insert(0, f"sheet {name} of the workbook is read")
            yield table


def _write_sheet(book: Any, chosen: str | None, target: Path) -> str:
    """Write a sheet as CSV; return its name."""
    if chosen is not None and chosen not in book.sheetnames:
        raise invalid_data("topic", chosen, f"a sheet of the workbook: {', '.join(book.sheetnames[:20])}")
    for sheet in [book[chosen]] if chosen is not None else book.worksheets:
        with target.open("w", encoding="utf-8", newline="") as file:
            writer, rows, width = csv.writer(file), 0, 0
            for row in sheet.iter_rows(values_only=True):
                cells = [_text(cell) for cell in row[: MAX_COLUMNS + 1]]
                used = max((j for j, cell in enumerate(cells, start=1) if cell), default=0)
                width = max(width, used)
                writer.writerow(cells[:width])
                rows += used > 0
        if rows > 1:
            return str(sheet.title)
    raise invalid_data("file", "a workbook without rows", "a sheet with column names and a row per time")


def _text(cell: Any) -> str:
    if isinstance(cell, datetime | time):
        return cell.isoformat(sep=" ") if isinstance(cell, datetime) else cell.isoformat()
    return "" if cell is None else repr(cell) if isinstance(cell, float) else str(cell)

"""Reading CSV and similar text: a line of column names, then rows, with any common separator and encoding."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path

import pyarrow as pa
import pyarrow.csv as pacsv

from lipcore.data.samples import Array
from service.datasets.formats.arrow import Node
from service.datasets.formats.cells import MISSING, ClockCells, NumberCells, StampCells, plan_cells
from service.datasets.formats.header import Naming
from service.datasets.formats.joint_labels import JointCycle, JointNames
from service.datasets.formats.table import (
    MAX_COLUMNS,
    Table,
    clean_names,
    describe_unread,
    first_line,
    name_columns,
    stack_blocks,
    unreadable,
)
from service.datasets.formats.text import BLANK, MAX_LINE_BYTES, TextLayout, TextLines, byte_error, read_layout
from service.datasets.formats.transposed import open_transposed
from service.datasets.options import ReadOptions
from service.foundation.errors import invalid_data, invalid_request
from service.foundation.settings import Settings

_DELIMITER_NAMES = {";": "semicolons", "\t": "tabs", "|": "bars", BLANK: "blanks"}
"""Delimiters that the report mentions."""


@contextmanager
def open_csv(path: Path, options: ReadOptions, settings: Settings, naming: Naming | None = None) -> Iterator[Table]:
    """Open a text table; raise InvalidDataError that names the row and column of an error.

    Columns of text are not read, except names of joints. An empty cell is a missing value. Dates become seconds since
    the first one. A table with one row for each joint gets one row for each time. naming: names the columns of a file
    without names, by default from `options.column_names`.
    """
    if naming is None and options.column_names is not None:
        naming = partial(name_columns, options.column_names)
    layout = read_layout(path, options.delimiter, naming)
    if layout.transposed:
        yield open_transposed(path, layout)
        return
    if options.column_names is not None and not layout.header.nameless:
        expected = "no `column_names` because the first line of the file holds names"
        raise invalid_request("column_names", ", ".join(options.column_names), expected)
    names = clean_names(layout.header.names)
    with closing(TextLines(path, layout.encoding, layout.header.lines, layout.delimiter == BLANK)) as lines:
        batches = _read_batches(lines, layout, len(names))
        first = next(batches, None)
        yield Table(names, iter(())) if first is None else _table(names, layout, first, batches)


def _table(
    names: tuple[str, ...], layout: TextLayout, first: pa.RecordBatch, batches: Iterator[pa.RecordBatch]
) -> Table:
    """Return the table of some rows of text."""
    cycle = JointCycle.find(names, first)
    readers: dict[int, Node] = {}
    for index, (name, cells) in enumerate(zip(names, first.columns, strict=True)):
        node = plan_cells(name, cells, layout.delimiter != ",", MAX_COLUMNS)
        if node is not None and (cycle is None or index != cycle.column):
            readers[index] = node
    text = [index for index in range(len(names)) if index not in readers]
    labels = JointNames.find(names, text, first)
    unread = [names[j] for j in text if not (labels and j in labels.columns) and not (cycle and j == cycle.column)]
    separator = _DELIMITER_NAMES.get(layout.delimiter)
    facts = [f"columns are separated by {separator}"] if separator else []
    facts += [*layout.facts, *layout.header.facts, *describe_unread(unread, "they hold no numbers")]
    stamps = [each.name for each in readers.values() if isinstance(each, StampCells | ClockCells)]
    facts += [f"{name} holds dates, which were converted to seconds since the first one" for name in stamps]
    units = {name: unit for name, unit in zip(names, layout.header.units, strict=False) if unit}
    units |= {name: unit for node in readers.values() for name, unit in node.units.items()}
    kept = clean_names([name for node in readers.values() for name in node.names])
    blocks = _blocks(first, batches, readers, facts, cycle, labels)
    if labels is not None:
        facts.append(f"joint names are read from {', '.join(labels.columns.values())}")
    if cycle is None:
        return Table(kept, blocks, None if labels is None else labels.names, units, facts)
    facts.append(f"each row is of one joint, named in {cycle.name}: {', '.join(cycle.labels)}")
    wide, places = cycle.names_of(kept)
    of = {name: units[kept[j]] for name, (_, j) in zip(wide, places, strict=True) if kept[j] in units}
    return Table(wide, cycle.pivot(blocks, kept, facts), None, of, facts)


def _blocks(
    first: pa.RecordBatch,
    batches: Iterator[pa.RecordBatch],
    readers: dict[int, Node],
    facts: list[str],
    cycle: JointCycle | None,
    labels: JointNames | None,
) -> Iterator[Array]:
    row, batch = 1, first
    while batch is not None and readers:
        if cycle is not None:
            cycle.check(batch.column(cycle.column), row)
        if labels is not None:
            labels.check(batch, row)
        yield from stack_blocks([each for j, node in readers.items() for each in node.read(batch.column(j), row)])
        row += batch.num_rows
        batch = next(batches, None)
    if any(isinstance(each, NumberCells) and each.commas for each in readers.values()):
        facts.append("numbers have decimal commas")


def _read_batches(lines: TextLines, layout: TextLayout, width: int) -> Iterator[pa.RecordBatch]:
    """Yield the rows as text cells; raise InvalidDataError if a row is not as wide as the header."""
    wrong: list[pacsv.InvalidRow] = []

    def note(row: pacsv.InvalidRow) -> str:
        wrong.append(row)
        return "error"

    keys = [str(index) for index in range(width)]
    try:
        reader = pacsv.open_csv(
            lines,
            read_options=pacsv.ReadOptions(use_threads=False, block_size=MAX_LINE_BYTES, column_names=keys),
            parse_options=pacsv.ParseOptions(
                delimiter=layout.delimiter,
                quote_char=layout.quote,
                newlines_in_values=layout.multiline,
                invalid_row_handler=note,
            ),
            convert_options=pacsv.ConvertOptions(
                column_types=dict.fromkeys(keys, pa.string()), strings_can_be_null=True, null_values=list(MISSING)
            ),
        )
        for batch in reader:
            if batch.num_rows:
                yield batch
    except UnicodeDecodeError as error:
        raise byte_error(error) from None
    except (pa.ArrowException, OSError, ValueError) as error:
        text = first_line(error)
        if "Empty CSV" in text:
            return
        if wrong:
            row, count = f"row {wrong[0].number}", f"{wrong[0].actual_columns} values"
            expected = f"{len(keys)} values, one per column of the header"
            raise invalid_data(row, count, expected, f"{row} has {count}, expected {expected}") from None
        if "straddl" in text:
            value, expected = f"a line of more than {MAX_LINE_BYTES} bytes", f"lines of at most {MAX_LINE_BYTES} bytes"
            raise invalid_data("file", value, expected, f"The file has {value}, expected {expected}.") from None
        separator = _DELIMITER_NAMES.get(layout.delimiter, "commas")
        raise unreadable("file", text, f"numbers separated by {separator}") from None

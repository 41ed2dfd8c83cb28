"""Reading JSON: one object a line, however many; or one file of an array of objects, or of an object of arrays."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec

from service.datasets.formats.json_rows import Rows, decode
from service.datasets.formats.table import Table, left_out
from service.datasets.options import ReadOptions
from service.foundation.errors import TooLargeError, invalid_data
from service.foundation.settings import Settings

ARRAYS = "an array of objects, or an object of arrays"


@contextmanager
def open_json_lines(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open a file of one JSON object a line as a table; raise InvalidDataError naming the line, or row and column."""
    rows = Rows(_lines(path, settings), settings)
    yield Table(rows.names, rows.blocks(), facts=rows.facts)


@contextmanager
def open_json(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open one JSON document as a table; raise InvalidDataError, or TooLargeError as it has to be in memory at once."""
    if (size := path.stat().st_size) > settings.max_json_bytes:
        raise TooLargeError(
            f"the JSON document has {size} bytes, expected at most {settings.max_json_bytes}: write one object a line "
            "(NDJSON), which may be longer"
        )
    rows, joint_names, facts = _document(path.read_bytes())
    table = Rows(rows, settings)
    yield Table(table.names, table.blocks(), joint_names=joint_names, facts=facts + table.facts)


def _lines(path: Path, settings: Settings) -> Iterator[Any]:
    most = settings.max_json_line_bytes
    number = 0
    with path.open("rb") as file:
        while line := file.readline(most + 1):
            number += 1
            if len(line) > most:
                raise invalid_data(f"line {number}", f"more than {most} bytes", f"lines of at most {most}")
            text = line.removeprefix(b"\xef\xbb\xbf").strip() if number == 1 else line.strip()
            if not text:
                continue
            try:
                yield decode(text)
            except ValueError as error:
                raise invalid_data(f"line {number}", f"not JSON: {error}", "one JSON object") from None


def _document(text: bytes) -> tuple[Iterator[Any], tuple[str, ...] | None, list[str]]:
    """Rows of a document, joint names where it has them, and facts."""
    text = text.removeprefix(b"\xef\xbb\xbf")
    try:
        if text.lstrip()[:1] == b"[":
            return iter(_items(text)), None, []
        document = decode(text)
    except ValueError as error:
        raise invalid_data("file", f"not JSON: {error}", ARRAYS) from None
    if type(document) is not dict:
        raise invalid_data("file", document, ARRAYS)
    data = document.get("data")
    if type(document.get("columns")) is list and type(data) is list:  # as pandas writes it, orient="split"
        keys = [str(key) for key in document["columns"]]
        return (_zipped(keys, row) for row in data), None, []
    if type(data) is list and all(type(each) is dict for each in data[:10]):  # orient="table", and others
        return iter(data), None, []
    return _columns(document)


def _items(text: bytes) -> list[Any] | Iterator[Any]:
    """Items of an array, each decoded when its turn comes where that is possible."""
    try:
        return (msgspec.json.decode(each) for each in msgspec.json.decode(text, type=list[msgspec.Raw]))
    except (msgspec.DecodeError, RecursionError):
        items = decode(text)
        if type(items) is not list:
            raise ValueError("no array") from None
        return items


def _zipped(keys: list[str], row: Any) -> Any:
    return dict(zip(keys, row, strict=True)) if type(row) is list and len(row) == len(keys) else row


def _columns(document: dict[str, Any]) -> tuple[Iterator[Any], tuple[str, ...] | None, list[str]]:
    """Rows of an object of arrays."""
    names = document.pop("joint_names", None)
    joint_names = tuple(map(str, names)) if type(names) is list else None
    columns: dict[str, list[Any]] = {}
    alone: list[str] = []
    _gather("", document, columns, alone)
    if not columns:
        raise invalid_data("file", ", ".join(alone[:10]) or "an empty object", ARRAYS)
    lengths = Counter(map(len, columns.values()))
    rows = max(lengths, key=lambda length: (lengths[length], length))
    for name, values in columns.items():
        if len(values) != rows:
            raise invalid_data(name, f"{len(values)} values", f"{rows} values, as most columns have")
    facts = left_out(alone, "they are no arrays")
    return ({name: values[row] for name, values in columns.items()} for row in range(rows)), joint_names, facts


def _gather(prefix: str, value: Any, columns: dict[str, list[Any]], alone: list[str]) -> None:
    if prefix.count(".") > 20:
        raise invalid_data("file", "nested deep", ARRAYS)
    if type(value) is list:
        columns[prefix] = value
    elif type(value) is dict and value and prefix and all(key.isdigit() for key in value):
        columns[prefix] = list(value.values())  # as pandas writes a column: values by the number of their row
    elif type(value) is dict:
        for key, part in value.items():
            _gather(f"{prefix}.{key}" if prefix else key, part, columns, alone)
    else:
        alone.append(prefix)

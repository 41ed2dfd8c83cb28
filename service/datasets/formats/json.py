"""Reading JSON: one object per line, an array of objects, or an object of arrays.

Each object is a sample. Nested values become columns `a.b` and `name[0]`.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from lipcore.data.samples import Array
from service.datasets.formats.table import MAX_COLUMNS, SAME_LENGTH, Table, block_rows, clean_names, describe_unread
from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError, TooLargeError, invalid_data
from service.foundation.settings import Settings

MAX_BYTES = 32 * 1024 * 1024
"""Max size of a JSON document, which is read as a whole. A file with one object per line may be larger."""
MAX_LINE_BYTES = 1024 * 1024
"""Max length of a line in a file with one object per line."""
MAX_DEPTH = 10

KeyPath = tuple[str | int, ...]
"""Keys and list indices that lead to a value in a row."""
Node = int | dict[str, "Node | None"] | list["Node | None"]
"""Tree of the numbers in a row: the index of a column, or parts by name or list index; None if there are none."""


class RowShape:
    """The key paths of numbers and other values in some rows, and the lengths of lists.

    Raise InvalidDataError if a row has more than `max_values` values or too many levels.
    """

    def __init__(self, rows: list[Any], max_values: int) -> None:
        self.max_values = max_values
        self.leaves: dict[KeyPath, list[int]] = {}
        self.lengths: dict[KeyPath, Counter[int]] = {}
        for row in rows:
            self._gather(row, ())

    def columns(self) -> tuple[list[KeyPath], list[KeyPath]]:
        """Return the paths of numbers in order, and the paths of values that are not numbers or have no fixed shape."""
        numbers: list[KeyPath] = []
        others: list[KeyPath] = []
        above = {path[:depth] for path in self.leaves for depth in range(1, len(path))}
        mixed = {path for path in above if self.leaves.get(path, (0, 0))[0]}
        for path, (count, other) in self.leaves.items():
            if path in above and not count and not other:
                continue  # a missing object or list
            if count < other or not self._is_fixed(path) or any(path[:depth] in mixed for depth in range(1, len(path))):
                others.append(path)
            elif all(path[len(at)] < self.length(at) for at in self._lists(path)):  # type: ignore[operator]
                numbers.append(path)
        return numbers, others

    def length(self, path: KeyPath) -> int:
        """Return the usual length of a list."""
        return self.lengths[path].most_common(1)[0][0]

    def plan(self, columns: list[KeyPath]) -> Node:
        """Return the tree of these columns."""
        root: Node = {}
        for index, path in enumerate(columns):
            root = self._place(root, path, 0, index)
        return root

    def _place(self, node: Node | None, path: KeyPath, depth: int, index: int) -> Node:
        if depth == len(path):
            return index
        head = path[depth]
        if isinstance(head, str):
            parts = node if isinstance(node, dict) else {}
            parts[head] = self._place(parts.get(head), path, depth + 1, index)
            return parts
        empty: list[Node | None] = [None] * self.length(path[:depth])
        places = node if isinstance(node, list) else empty
        places[head] = self._place(places[head], path, depth + 1, index)
        return places

    def _gather(self, value: Any, path: KeyPath) -> None:
        if len(path) > MAX_DEPTH:
            raise invalid_data(name_of(path[:3]), f"nested {len(path)} levels deep", f"at most {MAX_DEPTH} levels")
        if type(value) is dict:
            for key, part in value.items():
                self._gather(part, (*path, key))
        elif type(value) is list:
            if len(value) > self.max_values:
                expected = f"at most {self.max_values} values per row"
                raise invalid_data(name_of(path), f"a list of {len(value)} values", expected)
            if value:
                self.lengths.setdefault(path, Counter())[len(value)] += 1
            for place, part in enumerate(value):
                self._gather(part, (*path, place))
        else:
            count = self.leaves.setdefault(path, [0, 0])
            if len(self.leaves) > self.max_values:
                value, expected = f"more than {self.max_values}", f"at most {self.max_values}"
                raise invalid_data("columns", value, expected, f"The rows have {value} columns, expected {expected}.")
            if value is not None:
                count[type(value) not in (int, float)] += 1

    def _lists(self, path: KeyPath) -> list[KeyPath]:
        """Return the paths of the lists that contain a value."""
        return [path[:depth] for depth, part in enumerate(path) if isinstance(part, int)]

    def _is_fixed(self, path: KeyPath) -> bool:
        counts = [self.lengths[at] for at in self._lists(path)]
        return all(each.most_common(1)[0][1] >= SAME_LENGTH * each.total() for each in counts)


def name_of(path: KeyPath) -> str:
    """Return the column name of a path, such as `a.b[0]`."""
    name = ""
    for part in path:
        name += f"[{part}]" if isinstance(part, int) else f".{part}" if name else part
    return name


class Rows:
    """Rows that are objects, as blocks of numbers; missing or null becomes NaN.

    names: the columns that hold numbers in the first rows; facts: a sentence on the columns that are not read.
    """

    def __init__(self, rows: Iterator[Any]) -> None:
        self._rest = rows
        self._first = list(islice(rows, 1000))  # enough rows to find the columns
        for number, row in enumerate(self._first, start=1):
            _check_row(row, number)
        shape = RowShape(self._first, 2 * MAX_COLUMNS)
        numbers, others = shape.columns()
        self.names = clean_names(map(name_of, numbers))
        self.facts = describe_unread(
            [name_of(path) for path in others], "they hold no numbers, or lists of different lengths"
        )
        self._plan = shape.plan(numbers)

    def blocks(self) -> Iterator[Array]:
        """Yield float64 (rows, columns)."""
        step, width = block_rows(len(self.names)), len(self.names)
        filled, block = 0, np.full((step, width), np.nan)
        for row, each in enumerate(self._all_rows(), start=1):
            _check_row(each, row)
            values = [np.nan] * width
            self._fill(self._plan, each, values, row)
            block[filled] = values
            filled += 1
            if filled == step:
                yield block
                filled, block = 0, np.full((step, width), np.nan)
        if filled:
            yield block[:filled]

    def _all_rows(self) -> Iterator[Any]:
        yield from self._first
        self._first = []
        yield from self._rest

    def _fill(self, node: Node, value: Any, values: list[float], row: int) -> None:
        if isinstance(node, int):
            if type(value) is float:
                values[node] = value
            elif value is not None:
                values[node] = self._number(node, value, row)
        elif value is None:
            return
        elif isinstance(node, dict):
            if type(value) is not dict:
                raise self._wrong_type(node, value, "an object", row)
            for key, part in node.items():
                if part is not None:
                    self._fill(part, value.get(key), values, row)
        elif value != []:  # an empty list is a missing value
            if type(value) is not list:
                raise self._wrong_type(node, value, "a list", row)
            if len(value) != len(node):
                raise self._wrong_type(node, f"in a list of {len(value)} values", f"{len(node)} values", row)
            for part, item in zip(node, value, strict=True):
                if part is not None:
                    self._fill(part, item, values, row)

    def _number(self, index: int, value: Any, row: int) -> float:
        if type(value) is not int:
            raise invalid_data(f"{self.names[index]}, row {row}", value, "a number")
        try:
            return float(value)
        except OverflowError:
            return np.inf

    def _wrong_type(self, node: Any, value: Any, expected: str, row: int) -> InvalidDataError:
        while not isinstance(node, int):  # the first column below has a name for the error
            node = next(part for part in (node.values() if isinstance(node, dict) else node) if part is not None)
        return invalid_data(f"{self.names[node]}, row {row}", value, f"{expected}, as in the first rows")


def decode(text: bytes) -> Any:
    """Decode JSON, also with NaN and Infinity as Python writes them; raise ValueError."""
    try:
        return msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError):
        try:
            return json.loads(text)
        except RecursionError:
            raise ValueError("nested too deeply") from None


def _check_row(row: Any, number: int) -> None:
    if type(row) is not dict:
        raise invalid_data(f"row {number}", row, "an object that names every value")


EXPECTED = "an array of objects, or an object of arrays"


@contextmanager
def open_json_lines(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open a file of one JSON object per line as a table; raise InvalidDataError that names the line or the row."""
    rows = Rows(_read_lines(path))
    yield Table(rows.names, rows.blocks(), facts=rows.facts)


@contextmanager
def open_json(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open one JSON document as a table; raise InvalidDataError, or TooLargeError because it is read into memory."""
    if (size := path.stat().st_size) > MAX_BYTES:
        raise TooLargeError(
            f"The JSON document has {size} bytes, expected at most {MAX_BYTES}. Write one object per line (NDJSON) for "
            "larger files."
        )
    rows, joint_names, facts = _read_document(path.read_bytes())
    table = Rows(rows)
    yield Table(table.names, table.blocks(), joint_names=joint_names, facts=facts + table.facts)


def _read_lines(path: Path) -> Iterator[Any]:
    limit = MAX_LINE_BYTES
    number = 0
    with path.open("rb") as file:
        while line := file.readline(limit + 1):
            number += 1
            if len(line) > limit:
                raise invalid_data(f"line {number}", f"longer than {limit} bytes", f"at most {limit} bytes")
            text = line.removeprefix(b"\xef\xbb\xbf").strip() if number == 1 else line.strip()
            if not text:
                continue
            try:
                yield decode(text)
            except ValueError as error:
                raise invalid_data(f"line {number}", f"not JSON: {error}", "one JSON object") from None


def _read_document(text: bytes) -> tuple[Iterator[Any], tuple[str, ...] | None, list[str]]:
    """Return the rows of a document, its joint names or None, and facts."""
    text = text.removeprefix(b"\xef\xbb\xbf")
    try:
        if text.lstrip()[:1] == b"[":
            return iter(_items(text)), None, []
        document = decode(text)
    except ValueError as error:
        raise invalid_data("file", f"not JSON: {error}", EXPECTED) from None
    if type(document) is not dict:
        raise invalid_data("file", document, EXPECTED)
    data = document.get("data")
    if type(document.get("columns")) is list and type(data) is list:  # pandas with orient="split"
        keys = [str(key) for key in document["columns"]]
        return (_zip_row(keys, row) for row in data), None, []
    if type(data) is list and all(type(each) is dict for each in data[:10]):  # pandas with orient="table", and others
        return iter(data), None, []
    return _rows_of_columns(document)


def _items(text: bytes) -> list[Any] | Iterator[Any]:
    """Return the items of an array, each decoded when it is used if that is possible."""
    try:
        return _decode_items(msgspec.json.decode(text, type=list[msgspec.Raw]))
    except (msgspec.DecodeError, RecursionError):
        items = decode(text)
        if type(items) is not list:
            raise ValueError("not an array") from None
        return items


def _decode_items(items: list[msgspec.Raw]) -> Iterator[Any]:
    """Return the items of an array one by one; raise InvalidDataError for a number of too many digits."""
    for number, item in enumerate(items, start=1):
        try:
            yield decode(bytes(item))
        except ValueError as error:
            raise invalid_data(f"row {number}", f"not JSON: {error}", "one JSON object") from None


def _zip_row(keys: list[str], row: Any) -> Any:
    return dict(zip(keys, row, strict=True)) if type(row) is list and len(row) == len(keys) else row


def _rows_of_columns(document: dict[str, Any]) -> tuple[Iterator[Any], tuple[str, ...] | None, list[str]]:
    """Return the rows of an object of arrays, its joint names or None, and facts."""
    names = document.pop("joint_names", None)
    joint_names = tuple(map(str, names)) if type(names) is list else None
    columns: dict[str, list[Any]] = {}
    scalars: list[str] = []
    _gather_columns("", document, columns, scalars)
    if not columns:
        raise invalid_data(
            "file", f"an object of the values {', '.join(scalars[:10])}" if scalars else "an empty object", EXPECTED
        )
    lengths = Counter(map(len, columns.values()))
    rows = max(lengths, key=lambda length: (lengths[length], length))
    for name, values in columns.items():
        if len(values) != rows:
            raise invalid_data(name, f"an array of {len(values)} values", f"{rows} values, like most columns")
    facts = describe_unread(scalars, "they are not arrays")
    return ({name: values[row] for name, values in columns.items()} for row in range(rows)), joint_names, facts


def _gather_columns(prefix: str, value: Any, columns: dict[str, list[Any]], scalars: list[str]) -> None:
    if prefix.count(".") > 20:
        raise invalid_data("file", "nested too deeply", EXPECTED)
    if type(value) is list:
        columns[prefix] = value
    elif type(value) is dict and value and prefix and all(key.isdigit() for key in value):
        columns[prefix] = list(value.values())  # pandas writes a column as values by row number
    elif type(value) is dict:
        for key, part in value.items():
            _gather_columns(f"{prefix}.{key}" if prefix else key, part, columns, scalars)
    else:
        scalars.append(prefix)

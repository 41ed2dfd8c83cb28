"""Reading JSON: one object a line, however many; or one file of an array of objects, or of an object of arrays. Of
objects, one a sample, what is nested becomes columns `a.b` and `name[0]`."""

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
from service.datasets.formats.table import MAX_COLUMNS, SAME_LENGTH, Table, block_rows, checked_names, left_out
from service.datasets.options import ReadOptions
from service.foundation.errors import InvalidDataError, TooLargeError, invalid_data
from service.foundation.settings import Settings

MAX_BYTES = 32 * 1024 * 1024
"""Largest JSON document, which is read as a whole; one object a line may be longer."""
MAX_LINE_BYTES = 1024 * 1024
"""Longest line of JSON, one object a line."""
MAX_DEPTH = 10

Place = tuple[str | int, ...]
Node = int | dict[str, "Node | None"] | list["Node | None"]
"""Where numbers lie in a row: the index of a column, or parts by name or place; None where there are none."""


class Shape:
    """What was seen in some rows: numbers and other values by where they lie, and how long lists are.

    Raise InvalidDataError where a row has more than `most` values, or is nested deep.
    """

    def __init__(self, rows: list[Any], most: int) -> None:
        self.most = most
        self.leaves: dict[Place, list[int]] = {}
        self.lengths: dict[Place, Counter[int]] = {}
        for row in rows:
            self._gather(row, ())

    def columns(self) -> tuple[list[Place], list[Place]]:
        """Where numbers lie, in the order they were seen; and what is no number, or of no fixed shape."""
        numbers: list[Place] = []
        others: list[Place] = []
        above = {path[:depth] for path in self.leaves for depth in range(1, len(path))}
        alone = {path for path in above if self.leaves.get(path, (0, 0))[0]}
        for path, (count, other) in self.leaves.items():
            if path in above and not count and not other:
                continue  # an object or a list that is missing
            if count < other or not self._fixed(path) or any(path[:depth] in alone for depth in range(1, len(path))):
                others.append(path)
            elif all(path[len(at)] < self.length(at) for at in self._lists(path)):  # type: ignore[operator]
                numbers.append(path)
        return numbers, others

    def length(self, path: Place) -> int:
        """The usual length of a list."""
        return self.lengths[path].most_common(1)[0][0]

    def plan(self, columns: list[Place]) -> Node:
        """Where each of these columns lies."""
        root: Node = {}
        for index, path in enumerate(columns):
            root = self._place(root, path, 0, index)
        return root

    def _place(self, node: Node | None, path: Place, depth: int, index: int) -> Node:
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

    def _gather(self, value: Any, path: Place) -> None:
        if len(path) > MAX_DEPTH:
            raise invalid_data(name_of(path[:3]), f"nested {len(path)} deep", f"at most {MAX_DEPTH}")
        if type(value) is dict:
            for key, part in value.items():
                self._gather(part, (*path, key))
        elif type(value) is list:
            if len(value) > self.most:
                raise invalid_data(name_of(path), f"{len(value)} values a row", f"at most {self.most}")
            if value:
                self.lengths.setdefault(path, Counter())[len(value)] += 1
            for place, part in enumerate(value):
                self._gather(part, (*path, place))
        else:
            count = self.leaves.setdefault(path, [0, 0])
            if len(self.leaves) > self.most:
                raise invalid_data("columns", f"more than {self.most}", f"at most {self.most}")
            if value is not None:
                count[type(value) not in (int, float)] += 1

    def _lists(self, path: Place) -> list[Place]:
        """The lists that a value lies in."""
        return [path[:depth] for depth, part in enumerate(path) if isinstance(part, int)]

    def _fixed(self, path: Place) -> bool:
        counts = [self.lengths[at] for at in self._lists(path)]
        return all(each.most_common(1)[0][1] >= SAME_LENGTH * each.total() for each in counts)


def name_of(path: Place) -> str:
    """The name of what lies there: `a.b[0]`."""
    name = ""
    for part in path:
        name += f"[{part}]" if isinstance(part, int) else f".{part}" if name else part
    return name


class Rows:
    """Rows that are objects, as blocks of numbers; NaN where one is missing or null.

    names: of the columns, those that hold numbers in the first rows; facts: what is left out.
    """

    def __init__(self, rows: Iterator[Any]) -> None:
        self._rest = rows
        self._first = list(islice(rows, 1000))  # enough rows to find the columns
        for number, row in enumerate(self._first, start=1):
            _check(row, number)
        shape = Shape(self._first, 2 * MAX_COLUMNS)
        numbers, others = shape.columns()
        self.names = checked_names(map(name_of, numbers))
        self.facts = left_out([name_of(path) for path in others], "they hold no numbers, or lists of different lengths")
        self._plan = shape.plan(numbers)

    def blocks(self) -> Iterator[Array]:
        """float64 (rows, columns)."""
        most, width = block_rows(len(self.names)), len(self.names)
        filled, block = 0, np.full((most, width), np.nan)
        for row, each in enumerate(self._all(), start=1):
            _check(each, row)
            values = [np.nan] * width
            self._fill(self._plan, each, values, row)
            block[filled] = values
            filled += 1
            if filled == most:
                yield block
                filled, block = 0, np.full((most, width), np.nan)
        if filled:
            yield block[:filled]

    def _all(self) -> Iterator[Any]:
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
                raise self._other(node, value, "an object", row)
            for key, part in node.items():
                if part is not None:
                    self._fill(part, value.get(key), values, row)
        elif value != []:  # an empty list is a missing value
            if type(value) is not list:
                raise self._other(node, value, "a list", row)
            if len(value) != len(node):
                raise self._other(node, f"{len(value)} values", f"{len(node)} values", row)
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

    def _other(self, node: Any, value: Any, expected: str, row: int) -> InvalidDataError:
        while not isinstance(node, int):  # to the first column in there, as it has a name
            node = next(part for part in (node.values() if isinstance(node, dict) else node) if part is not None)
        return invalid_data(f"{self.names[node]}, row {row}", value, f"{expected} as in the first rows")


def decode(text: bytes) -> Any:
    """JSON, with NaN and Infinity as Python's writer puts them; raise ValueError."""
    try:
        return msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError):
        try:
            return json.loads(text)
        except RecursionError:
            raise ValueError("nested too deep") from None


def _check(row: Any, number: int) -> None:
    if type(row) is not dict:
        raise invalid_data(f"row {number}", row, "an object with a name for every value")


ARRAYS = "an array of objects, or an object of arrays"


@contextmanager
def open_json_lines(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open a file of one JSON object a line as a table; raise InvalidDataError naming the line, or row and column."""
    rows = Rows(_lines(path))
    yield Table(rows.names, rows.blocks(), facts=rows.facts)


@contextmanager
def open_json(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open one JSON document as a table; raise InvalidDataError, or TooLargeError as it has to be in memory at once."""
    if (size := path.stat().st_size) > MAX_BYTES:
        raise TooLargeError(
            f"the JSON document has {size} bytes, expected at most {MAX_BYTES}: write one object a line "
            "(NDJSON), which may be longer"
        )
    rows, joint_names, facts = _document(path.read_bytes())
    table = Rows(rows)
    yield Table(table.names, table.blocks(), joint_names=joint_names, facts=facts + table.facts)


def _lines(path: Path) -> Iterator[Any]:
    most = MAX_LINE_BYTES
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

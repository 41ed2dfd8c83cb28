"""Where numbers lie in nested objects of JSON: found out from the first of them."""

from __future__ import annotations

from collections import Counter
from typing import Any

from service.foundation.errors import invalid_data

MAX_DEPTH = 10
SAME = 0.9
"""Share of a list's rows that must be of one length: then another is an error, else the list is of no fixed shape."""

Path = tuple[str | int, ...]
Node = int | dict[str, "Node | None"] | list["Node | None"]
"""Where numbers lie in a row: the index of a column, or parts by name or place; None where there are none."""


class Shape:
    """What was seen in some rows: numbers and other values by where they lie, and how long lists are.

    Raise InvalidDataError where a row has more than `most` values, or is nested deep.
    """

    def __init__(self, rows: list[Any], most: int) -> None:
        self.most = most
        self.leaves: dict[Path, list[int]] = {}
        self.lengths: dict[Path, Counter[int]] = {}
        for row in rows:
            self._gather(row, ())

    def columns(self) -> tuple[list[Path], list[Path]]:
        """Where numbers lie, in the order they were seen; and what is no number, or of no fixed shape."""
        numbers: list[Path] = []
        others: list[Path] = []
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

    def length(self, path: Path) -> int:
        """The usual length of a list."""
        return self.lengths[path].most_common(1)[0][0]

    def plan(self, columns: list[Path]) -> Node:
        """Where each of these columns lies."""
        root: Node = {}
        for index, path in enumerate(columns):
            root = self._place(root, path, 0, index)
        return root

    def _place(self, node: Node | None, path: Path, depth: int, index: int) -> Node:
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

    def _gather(self, value: Any, path: Path) -> None:
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

    def _lists(self, path: Path) -> list[Path]:
        """The lists that a value lies in."""
        return [path[:depth] for depth, part in enumerate(path) if isinstance(part, int)]

    def _fixed(self, path: Path) -> bool:
        counts = [self.lengths[at] for at in self._lists(path)]
        return all(each.most_common(1)[0][1] >= SAME * each.total() for each in counts)


def name_of(path: Path) -> str:
    """The name of what lies there: `a.b[0]`."""
    name = ""
    for part in path:
        name += f"[{part}]" if isinstance(part, int) else f".{part}" if name else part
    return name

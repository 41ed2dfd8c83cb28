"""What every format is read as: named columns of numbers, block after block."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from lipcore.data.samples import Array

BLOCK_ROWS = 16_384
"""Most rows of a block: what is held in memory of a file, however long it is."""


@dataclass
class Table:
    """A recording as its file holds it; to be read once, while the file is open.

    names: of the columns, as the file has them; blocks: float64 (rows, columns), 1 to BLOCK_ROWS rows each, NaN where a
    value is missing; joint_names: of joints 1..n, where the file says them apart from its columns; units: of columns by
    name, where the file says them; facts: what was found on the way, one sentence each, complete once the blocks are
    read.
    """

    names: tuple[str, ...]
    blocks: Iterator[Array]
    joint_names: tuple[str, ...] | None = None
    units: dict[str, str] = field(default_factory=dict)
    facts: list[str] = field(default_factory=list)

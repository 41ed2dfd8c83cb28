"""Joint names in the cells of a text table: beside numbered columns, or in tables with one row for each joint."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lipcore.data.samples import Array
from service.datasets.mapping.recognition import find_times, interpret_name
from service.foundation.errors import invalid_data

MAX_CYCLE = 100
"""Max joints of a table with one row for each."""
_NAMES = re.compile(r"(?:.*[./_ ])?(?:joint_?)?names?[\[_. ]?(\d*)\]?", re.IGNORECASE)
_LABEL = re.compile(
    r"(?:.*[./])?(?:(?:joint|axis|motor|servo)(?:[_ ]?(?:name|id|index|number|no))?|name)", re.IGNORECASE
)


@dataclass(frozen=True)
class JointNames:
    """Columns whose cells hold the names of joints 1..n, the same in every row.

    columns: their names by index, in the order of the joints. names: of the joints.
    """

    columns: Mapping[int, str]
    cells: tuple[str, ...]
    names: tuple[str, ...]

    @classmethod
    def find(cls, names: Sequence[str], text: Sequence[int], first: pa.RecordBatch) -> JointNames | None:
        """Return the columns with joint names among those of text, None if there are none."""
        found = {j: match for j in text if (match := _NAMES.fullmatch(names[j].strip()))}
        order = sorted(found, key=lambda j: int(found[j][1] or 0))
        cells = tuple(str(first.column(j)[0].as_py() or "") for j in order)
        listed = tuple(re.findall(r"['\"]([^'\"]+)['\"]", cells[0])) if len(cells) == 1 else cells
        if len(listed) < 2 or not all(listed) or len(set(listed)) < len(listed):
            return None
        return cls({j: names[j] for j in order}, cells, listed)

    def check(self, batch: pa.RecordBatch, first_row: int) -> None:
        """Raise InvalidDataError if a row has other names."""
        for (j, name), cell in zip(self.columns.items(), self.cells, strict=True):
            wrong = pc.fill_null(pc.not_equal(batch.column(j), cell), True)
            if (place := pc.index(wrong, True).as_py()) >= 0:
                found = batch.column(j)[place].as_py()
                raise invalid_data(f"{name}, row {first_row + place}", found, f"{cell}, as in the first row")


PIVOT = (
    "one row for each time, or the joints of each time in the same order. Pivot the table, for example with pandas: "
    "wide = frame.pivot(index='{time}', columns='{name}'); wide.columns = [f'{{joint}}/{{column}}' for column, joint "
    "in wide.columns]; wide.to_csv('wide.csv')"
)


@dataclass(frozen=True)
class JointCycle:
    """A table with one row for each joint, in the same order at each time.

    column: index of the column with the joint's name or number. time: a column of times. labels: in order.
    """

    column: int
    name: str
    time: str
    labels: tuple[str, ...]

    @classmethod
    def find(cls, names: Sequence[str], first: pa.RecordBatch) -> JointCycle | None:
        """Return the cycle of a table, None if it has one row for each time; raise InvalidDataError if it has none."""
        columns = [j for j, name in enumerate(names) if _LABEL.fullmatch(name.strip())]
        times = find_times(names)
        if len(columns) != 1 or not times:
            return None
        cells, clock = first.column(columns[0]), first.column(times[0].parts[-1][0])
        labels = tuple(str(cell or "").strip() for cell in pc.unique(cells).to_pylist())
        if not 1 < len(labels) <= min(MAX_CYCLE, len(cells) // 2) or not all(map(_is_label, labels)):
            return None
        restart = pc.index(pc.not_equal(cells, cells[0]), True).as_py()  # the first row of another joint
        if clock[restart] != clock[0]:
            return None
        cycle = cls(columns[0], names[columns[0]], times[0].name, labels)
        cycle.check(cells, 1)
        return cycle

    def check(self, cells: pa.Array, first_row: int) -> None:
        """Raise InvalidDataError if a row is of another joint than its place in the cycle. first_row: from 1."""
        expected = np.resize(np.roll(self.labels, -((first_row - 1) % len(self.labels))), len(cells))
        wrong = expected != np.array([str(cell or "").strip() for cell in cells.to_pylist()])
        if wrong.any():
            place = int(wrong.argmax())
            where, needed = f"{self.name}, row {first_row + place}", PIVOT.format(time=self.time, name=self.name)
            raise invalid_data(where, cells[place].as_py(), needed)

    def names_of(self, names: Sequence[str]) -> tuple[tuple[str, ...], list[tuple[int, int]]]:
        """Return the names of the columns of a table with one row for each time, and their places.

        A place is the joint, and the index of the column in the table with one row for each joint.
        """
        out, places = [], []
        for j, name in enumerate(names):
            of_joints = bool(interpret_name(name))
            for joint, label in enumerate(self.labels if of_joints else self.labels[:1]):
                out.append((f"{name}{label}" if label.isdecimal() else f"{label}/{name}") if of_joints else name)
                places.append((joint, j))
        return tuple(out), places

    def pivot(self, blocks: Iterator[Array], names: Sequence[str], facts: list[str]) -> Iterator[Array]:
        """Yield the blocks of a table with one row for each time; raise InvalidDataError if joints differ in time."""
        size, rest, row = len(self.labels), np.empty((0, len(names))), 0
        times = sorted({j for clock in find_times(names) for j, _ in clock.parts})
        joints, columns = np.array(self.names_of(names)[1]).T
        for block in blocks:
            rows = np.concatenate([rest, block])
            count = len(rows) // size
            groups, rest = rows[: count * size].reshape(count, size, -1), rows[count * size :]
            wrong = np.argwhere(groups[:, :, times] != groups[:, :1, times])
            if len(wrong):
                group, joint, j = wrong[0]
                found, expected = groups[group, joint, times[j]], groups[group, 0, times[j]]
                where = f"{names[times[j]]}, row {row + group * size + joint + 1}"
                raise invalid_data(where, f"{found:.15g}", f"{expected:.15g}, the time of the joints before")
            row += count * size
            if count:
                yield groups[:, joints, columns]
        if len(rest):
            facts.append(f"the last {len(rest)} rows are left out because joints are missing at that time")


def _is_label(text: str) -> bool:
    """Return whether a text is a name, or an integer."""
    return text.isdecimal() or re.search("[^\\W\\d]", text) is not None

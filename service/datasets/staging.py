"""Columns of a recording on disk, one file each: no more than one has to be in memory, however long the recording."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from service.storage.disk import Disk

TIME, EPISODE = "t", "episode"
QUANTITIES = ("q", "dq", "ddq", "tau")


def column(quantity: str, joint: int) -> str:
    """Name of the column of a quantity of a joint, counted from 0: `q1` is the position of joint 0."""
    return f"{quantity}{joint + 1}"


class Staged:
    """Columns by canonical name (`t`, `episode`, `q1`…): float64 (rows,), SI units, NaN where a value is missing.

    joint_names: of joints 1..n. Whoever makes one removes its folder, see `staging`.
    """

    def __init__(self, folder: Path, joint_names: tuple[str, ...], disk: Disk) -> None:
        self.folder, self.joint_names, self.disk = folder, joint_names, disk
        self._rows: dict[str, int] = {}
        self._missing: NDArray[np.bool_] | None = None

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joint_names)

    @property
    def rows(self) -> int:
        """Rows so far: of the longest column."""
        return max(self._rows.values(), default=0)

    @property
    def quantities(self) -> tuple[str, ...]:
        """Those of q, dq, ddq, tau that there are columns of."""
        return tuple(each for each in QUANTITIES if column(each, 0) in self._rows)

    def __contains__(self, name: str) -> bool:
        return name in self._rows

    def append(self, columns: Mapping[str, Array]) -> None:
        """Write more rows (M,) of some columns; raise StorageFullError."""
        self.disk.take(sum(values.nbytes for values in columns.values()))
        for name, values in columns.items():
            with (self.folder / f"{name}.f64").open("ab") as file:
                file.write(np.ascontiguousarray(values, np.float64).data)
            self._rows[name] = self._rows.get(name, 0) + len(values)
        self._missing = None

    def read(self, name: str) -> Array:
        """One column, (rows,); raise KeyError where there is none."""
        count = self._rows[name]
        found: Array = np.fromfile(self.folder / f"{name}.f64", np.float64)
        if len(found) != count:
            raise OSError(f"column {name} has {len(found)} rows on disk, expected {count}")
        return found

    def missing(self) -> NDArray[np.bool_]:
        """Rows in which any value is missing, (rows,); looked up once, as that reads all columns."""
        if self._missing is None:
            self._missing = np.zeros(self.rows, dtype=np.bool_)
            for name in self._rows:
                self._missing |= ~np.isfinite(self.read(name))
        return self._missing

    def joint(self, index: int) -> dict[str, Array]:
        """Columns of one joint by quantity."""
        return {each: self.read(column(each, index)) for each in self.quantities}

    def table(self, quantity: str, rows: slice | np.ndarray = slice(None)) -> Array:
        """A quantity of all joints at some rows, (M, n): for figures on a few rows, as the whole may be large."""
        return np.column_stack([self.read(column(quantity, joint))[rows] for joint in range(self.n_joints)])


@contextmanager
def staging(folder: Path) -> Iterator[Path]:
    """A folder for columns, removed at the end; what a killed service leaves below `folder` is swept at its start."""
    path = Path(tempfile.mkdtemp(dir=folder))
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)

"""Columns of a recording on disk, one file each, so that only a few are in memory at a time."""

from __future__ import annotations

import shutil
import stat
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lipcore.data.brakes import BrakedRows, find_braked_rows
from lipcore.data.outliers import CorruptRowsError, find_corrupt_rows
from lipcore.data.samples import Array
from lipcore.preparation.plan import plan
from lipcore.preparation.recipe import PreparationError, Recipe
from service.foundation.errors import invalid_data, readable
from service.storage.disk import Disk, DiskBudget

TIME, EPISODE = "t", "episode"
POSES_HINT = ". Set poses=true if every row is a held pose"
NO_TIMES_HINT = (
    '. Set dt=0.01 if the rows are 0.01 s apart, columns={"t": "…"} if a column of another name holds the times, or '
    "poses=true if every row is a held pose"
)
QUANTITIES = ("q", "dq", "ddq", "tau")
SAME_POSE = 0.01
"""Max change of each position, rad or m, from row to row of the same pose."""


def column(quantity: str, joint: int) -> str:
    """Return the column name of a quantity of a joint, counted from 0: `q1` is the position of joint 0."""
    return f"{quantity}{joint + 1}"


class Staged:
    """Columns by canonical name (`t`, `episode`, `q1`…): float64 (rows,), SI units, NaN if a value is missing.

    joint_names: of joints 1..n. The caller removes the folder, see `staging`.
    """

    def __init__(self, folder: Path, joint_names: tuple[str, ...], disk: Disk | DiskBudget) -> None:
        self.folder, self.joint_names, self.disk = folder, joint_names, disk
        self._rows: dict[str, int] = {}
        self._missing: NDArray[np.bool_] | None = None

    @classmethod
    def of_others(cls, folder: Path, joint_names: tuple[str, ...], lengths: Mapping[str, int], disk: Disk) -> Staged:
        """Return columns that the confined reader, which is not trusted, has written.

        Raise InvalidDataError if a column is missing or is not a regular file: a link could expose other files.
        """
        staged = cls(folder, joint_names, disk)
        known = {TIME, EPISODE, *(column(each, joint) for each in QUANTITIES for joint in range(len(joint_names)))}
        for name, rows in lengths.items():
            path = folder / f"{name}.f64"
            status = path.lstat() if name in known and path.exists() else None
            if status is None or not stat.S_ISREG(status.st_mode) or status.st_nlink > 1 or status.st_size != 8 * rows:
                message = f"The file could not be read: column `{readable(name[:200])}` is missing or damaged."
                raise invalid_data("file", f"without column {name}", "a readable file", message)
        staged._rows = dict(lengths)
        return staged

    @property
    def lengths(self) -> dict[str, int]:
        """Rows of each column."""
        return dict(self._rows)

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joint_names)

    @property
    def rows(self) -> int:
        """Rows of the longest column."""
        return max(self._rows.values(), default=0)

    @property
    def quantities(self) -> tuple[str, ...]:
        """Those of q, dq, ddq and tau that have columns."""
        return tuple(each for each in QUANTITIES if column(each, 0) in self._rows)

    def __contains__(self, name: str) -> bool:
        return name in self._rows

    def append(self, columns: Mapping[str, Array]) -> None:
        """Append rows (M,) to some columns; raise StorageFullError."""
        self.disk.reserve(sum(values.nbytes for values in columns.values()))
        for name, values in columns.items():
            with (self.folder / f"{name}.f64").open("ab") as file:
                file.write(np.ascontiguousarray(values, np.float64).data)
            self._rows[name] = self._rows.get(name, 0) + len(values)
        self._missing = None

    def read(self, name: str) -> Array:
        """Return one column, (rows,); raise KeyError if there is none."""
        count = self._rows[name]
        values: Array = np.fromfile(self.folder / f"{name}.f64", np.float64)
        if len(values) != count:
            raise OSError(f"column {name} has {len(values)} rows on disk, expected {count}")
        return values

    def average_poses(self) -> int:
        """Replace consecutive rows at the same pose by their mean, add velocities and accelerations of zero.

        Each pose is an episode. Rows that lack a value are dropped. Return the number of poses.
        """
        complete = ~self.missing()
        moved = np.zeros(int(complete.sum()), dtype=np.bool_)
        for joint in range(self.n_joints):
            q = self.read(column("q", joint))[complete]
            moved |= np.abs(np.diff(q, prepend=q[:1])) > SAME_POSE
        starts = np.flatnonzero(np.concatenate([[True], moved[1:]])) if len(moved) else np.zeros(0, np.int64)
        counts = np.diff(np.append(starts, len(moved)))
        for name in list(self._rows):
            values = self.read(name)[complete]
            (np.add.reduceat(values, starts) / counts if len(starts) else values).tofile(self.folder / f"{name}.f64")
            self._rows[name] = len(starts)
        self._missing = None
        zeros = np.zeros(len(starts))
        self.append({EPISODE: np.arange(float(len(starts)))})
        self.append({column(each, joint): zeros for each in ("dq", "ddq") for joint in range(self.n_joints)})
        return len(starts)

    def scale(self, quantity: str, factors: Array) -> None:
        """Multiply a quantity of each joint by a factor, (n,)."""
        for joint, factor in enumerate(factors):
            name = column(quantity, joint)
            (self.read(name) * factor).tofile(self.folder / f"{name}.f64")

    def missing(self) -> NDArray[np.bool_]:
        """Return whether each row lacks a value, (rows,). The result is cached, because all columns are read."""
        if self._missing is None:
            self._missing = np.zeros(self.rows, dtype=np.bool_)
            for name in self._rows:
                self._missing |= ~np.isfinite(self.read(name))
        return self._missing

    def joint(self, index: int) -> dict[str, Array]:
        """Return the columns of one joint by quantity."""
        return {each: self.read(column(each, index)) for each in self.quantities}

    def table(self, quantity: str, rows: slice | np.ndarray = slice(None)) -> Array:
        """Return a quantity of all joints at some rows, (M, n); all rows may not fit in memory."""
        return np.column_stack([self.read(column(quantity, joint))[rows] for joint in range(self.n_joints)])


@contextmanager
def staging(folder: Path) -> Iterator[Path]:
    """Create a folder for columns and remove it at the end; at its start, the service removes leftovers."""
    path = Path(tempfile.mkdtemp(dir=folder))
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


@dataclass(frozen=True)
class Prepared:
    """Prepared samples, ready for training."""

    staged: Staged
    """`t`, `episode`, and q, dq, ddq, tau of all joints, finite, (M,) each."""
    steps: list[dict[str, Any]]
    """Steps in order, each a JSON object with `step`, its parameters and `text`, a sentence."""
    episodes: int
    """Number of contiguous parts."""
    rate_hz: float | None
    """Sampling rate, None without times."""
    cutoff_hz: float | None
    """Cut-off of the low-pass, None without one."""
    derived: tuple[str, ...]
    """Those of "dq" and "ddq" that were derived."""
    gaps: int
    """Number of gaps in time at which the recording was split."""
    missing: int
    """Rows dropped because a value is missing."""
    repeated: int
    """Rows dropped because their time stamp repeats an earlier one."""
    braked: BrakedRows
    """Rows of the recording dropped because they have closed brakes."""


def prepare(
    raw: Staged, folder: Path, recipe: Recipe, min_samples: int, disk: Disk | DiskBudget | None = None
) -> Prepared:
    """Prepare staged columns, NaN if a value is missing, in a new folder below `folder`.

    Only a few columns are in memory at a time. Raise InvalidDataError if the recipe cannot be applied or fewer than
    `min_samples` remain; StorageFullError.
    """
    t, episode, missing = _or_none(raw, TIME), _or_none(raw, EPISODE), raw.missing()
    numbers = np.zeros(raw.rows) if episode is None else episode

    def read(quantity: str, joint: int) -> Array:
        return raw.read(column(quantity, joint))

    try:
        damaged = find_corrupt_rows(t, numbers, raw.n_joints, read, raw.quantities)
        braked = find_braked_rows(t, numbers, raw.n_joints, read)
        made = plan(t, episode, missing, raw.quantities, recipe, damaged.rows, braked.rows)
    except (CorruptRowsError, PreparationError) as error:
        hint = NO_TIMES_HINT if (error.field, error.value) == (TIME, "missing") else ""
        hint = POSES_HINT if error.field == "cutoff" else hint
        raise invalid_data(error.field, error.value, f"{error.expected}{hint}", f"{error}{hint}") from None
    if len(made) < min_samples:
        why = "trimming the filter's edges" if made.cutoff is not None else "dropping unusable rows"
        raise invalid_data("rows", len(made), f"at least {min_samples} samples after {why}")
    own = folder / "prepared"  # the columns of the recording have the same names
    own.mkdir()
    staged = Staged(own, raw.joint_names, raw.disk if disk is None else disk)
    staged.append({TIME: made.t, EPISODE: made.episode.astype(np.float64)})

    def columns(joint: int) -> Iterator[tuple[str, Array]]:
        return made.columns(lambda quantity: read(quantity, joint))

    for joint in range(raw.n_joints):
        for name, values in columns(joint):
            staged.append({column(name, joint): values})
    return Prepared(
        staged,
        made.steps,
        episodes=made.episodes,
        rate_hz=made.rate,
        cutoff_hz=made.cutoff,
        derived=made.derived,
        gaps=made.gaps,
        missing=made.missing,
        repeated=made.repeated,
        braked=braked,
    )


def _or_none(raw: Staged, name: str) -> Array | None:
    return raw.read(name) if name in raw else None

"""Corrupt rows of a recording: magnitudes that no robot reaches, and rows that fit neither their past nor their future.

A flipped bit, a lost packet or a loose plug corrupts one or two rows. One such row may spoil a whole fit, because its
square enters every sum. A correct torque may jump, as friction does at a reversal, or rise within a row when a move
begins. But it then continues the rows before it or the rows after it. A corrupt value continues neither.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from lipcore.data.samples import Array, Samples

Mask = NDArray[np.bool_]

MAX_TORQUE = 1e6
"""Max |tau| of a robot, N·m (N); the largest arms reach some 1e4. The square of a larger number would drown every
sum."""
MAX_VALUES = {"q": 1e5, "dq": 1e4, "ddq": 1e6, "tau": MAX_TORQUE}
"""Max magnitudes of all quantities: rad, rad/s, rad/s² (m, m/s, m/s²), N·m (N). Continuous joints turn often."""


@dataclass(frozen=True)
class OutlierOptions:
    """Limits beyond which a row is corrupt.

    `usual_quantile`, `max_deviations`, `max_usual_changes`, `lead` and `turn_factor` were tuned on 612 simulated
    recordings of a double pendulum and a UR5 (seeds 1 and 2), clean, with Coulomb friction and with `Dirt`, at 10 to
    250 Hz. In two of the UR5's 252 recordings a sound row was left out: moves of 0.1 to 0.5 s, sampled at 10 Hz.
    """

    neighbours: int = 8
    """Rows on either side that a row is compared with."""
    skipped: int = 2
    """Nearest rows on either side that are not compared, because the row spoils their deviation."""
    usual_quantile: float = 0.8
    """Quantile of the neighbours' deviations that counts as usual: two of 12 neighbours may be corrupt themselves."""
    max_deviations: float = 12.0
    """Max deviation of a row, in usual deviations of its neighbours."""
    min_spread_share: float = 0.02
    """Min deviation of a corrupt row, as a share of the column's spread (2nd to 98th percentile)."""
    end_rows: int = 3
    """First and last rows of an episode, which are not checked: only one of their sides is recorded."""
    min_rows: int = 12
    """Min rows of an episode to compare its rows with their neighbours."""
    far_ratio: float = 30.0
    """In a shorter episode a row is corrupt if it is this many times as far from the median as all others."""
    max_share: float = 0.02
    max_rows: int = 3
    """Max corrupt rows, as a share of the recording or a count, whichever is larger. More rows have another cause."""
    max_usual_changes: float = 4.0
    """A change of motion by at least this many usual changes explains a deviation of torque, and vice versa. The
    explained deviation grows with the square of the change."""
    lead: float = 4.0
    """A corrupt row deviates this many times as much as the next one. If sampling is so slow that a move takes
    one row, many rows deviate by similar amounts."""
    turn_factor: float = 20.0
    """Factor on a torque's allowed deviation at a reversal of its joint: friction jumps, and jumps back if two
    reversals lie one row apart."""
    max_rounds: int = 3
    """Max rounds: corrupt rows may hide each other, so the remaining rows are checked again."""


OPTIONS = OutlierOptions()


class CorruptRowsError(ValueError):
    """So many rows are corrupt that it is no accident. field, value, expected: what is wrong."""

    def __init__(self, value: str, expected: str) -> None:
        super().__init__(f"rows: {value}, expected {expected}")
        self.field, self.value, self.expected = "rows", value, expected


@dataclass(frozen=True)
class CorruptRows:
    """Corrupt rows, which are left out. rows: (N,) mask; why: (N,) index of the reason in `REASONS`."""

    rows: Mask
    why: NDArray[np.int64]

    @property
    def count(self) -> int:
        """Return the number of corrupt rows."""
        return int(np.count_nonzero(self.rows))

    @property
    def first(self) -> list[int]:
        """Return the first ten corrupt rows, counted from 0."""
        return [int(row) for row in np.flatnonzero(self.rows)[:10]]

    def report(self) -> dict[str, Any]:
        """Return for JSON the number of corrupt rows, the first of them, counted from 0, and the number per reason."""
        reasons = {name: int(np.count_nonzero(self.why[self.rows] == at)) for at, name in enumerate(REASONS)}
        return {"rows": self.count, "first": self.first, "why": {name: many for name, many in reasons.items() if many}}

    def fit_entries(self) -> dict[str, int | str]:
        """Return the same as numbers and texts of a fit's report; empty if no row is corrupt."""
        if not self.count:
            return {}
        why = ", ".join(f"{many} by {name}" for name, many in self.report()["why"].items())
        first = ", ".join(map(str, self.first))
        return {"samples_corrupt": self.count, "corrupt": f"{why}; the first are rows {first}, counted from 0"}


REASONS = ("magnitude", "course")
"""Reasons why a row is corrupt: a magnitude that no robot reaches; or a value that continues neither the rows before
nor the rows after, while what it depends on changes as usual."""
ColumnReader = Callable[[str, int], Array]
"""Returns the column of a quantity of a joint, (N,)."""


def find_corrupt_rows(
    t: Array | None,
    episode: NDArray[Any],
    n_joints: int,
    read: ColumnReader,
    quantities: Sequence[str] = tuple(MAX_VALUES),
) -> CorruptRows:
    """Return the corrupt rows of a recording.

    t: (N,) s, in any order, None if unknown; episode: (N,), equal over one contiguous recording; read: returns a column
    of q, dq, ddq or tau, NaN if missing. One column at a time is in memory.
    Raise CorruptRowsError naming the first rows if too many are corrupt.
    """
    course = _Course.of(t, episode)
    count = len(course.order)
    rows, why = np.zeros(count, np.bool_), np.zeros(count, np.int64)
    apart = REASONS.index("course")
    columns = [(name, joint) for joint in range(n_joints) for name in sorted(quantities)]  # velocities before torques
    turning = np.zeros(count, np.bool_)
    for turn in range(OPTIONS.max_rounds):
        before = rows.copy()
        sides = {side: _Side(np.zeros(count), np.zeros(count)) for side in (True, False)}
        for name, joint in columns:
            values = read(name, joint)
            if turn == 0:
                impossible = np.abs(values) > MAX_VALUES[name]
                far = _far(np.where(impossible, np.nan, values))
                why[far & ~rows] = apart
                rows |= impossible | far
            deviates, change = course.measure(np.where(rows, np.nan, values))
            if name == "dq":
                turning = course.turning(values)
            elif name == "tau":
                deviates[turning] /= OPTIONS.turn_factor
            sides[name == "tau"].include(deviates, change)
        for side, other in ((True, False), (False, True)):
            explained = np.maximum(sides[other].change / OPTIONS.max_usual_changes, 1.0) ** 2
            alone = _leading(sides[side].deviation / explained, 1.0, OPTIONS.lead)
            why[alone & ~rows] = apart
            rows |= alone
        if (rows == before).all():
            break
    corrupt_rows = CorruptRows(rows, why)
    max_rows = _max_corrupt_rows(count)
    if corrupt_rows.count > max_rows:
        first = ", ".join(str(each + 1) for each in corrupt_rows.first)
        raise CorruptRowsError(
            f"{corrupt_rows.count} corrupt of {count} (the first are {first}, counted from 1)",
            f"at most {max_rows}",
        )
    return corrupt_rows


def find_in_samples(samples: Samples) -> CorruptRows:
    """Return the corrupt rows of samples; raise as `find_corrupt_rows` does."""
    return find_corrupt_rows(
        samples.t, samples.episode, samples.n_joints, lambda name, joint: np.asarray(getattr(samples, name)[:, joint])
    )


def find_in_blocks(rows: int, read_rows: Callable[[int, int], Samples], block: int = 50_000) -> CorruptRows:
    """Return the corrupt rows of a recording that is not in memory, block by block; raise as `find_corrupt_rows` does.

    read_rows: returns the samples from one row to another, exclusive; block: rows that are checked together.
    """
    parts: list[CorruptRows] = []
    overlap = 2 * OPTIONS.neighbours
    for first in range(0, rows, block):
        begin, end = max(0, first - overlap), min(rows, first + block + overlap)
        inner = slice(first - begin, min(first + block, rows) - begin)
        try:
            inner_rows = find_in_samples(read_rows(begin, end))
        except CorruptRowsError as error:
            raise CorruptRowsError(f"from row {begin + 1} on: {error.value}", error.expected) from None
        parts.append(CorruptRows(inner_rows.rows[inner], inner_rows.why[inner]))
    return CorruptRows(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("rows", "why")))


@dataclass(frozen=True)
class _Side:
    """Largest deviation, in allowed deviations, and change, in usual changes, over the columns of torque or of motion.

    Each is (N,).
    """

    deviation: Array
    change: Array

    def include(self, deviation: Array, change: Array) -> None:
        """Include one more column."""
        np.maximum(self.deviation, deviation, out=self.deviation)
        np.maximum(self.change, change, out=self.change)


@dataclass(frozen=True)
class _Course:
    """Rows sorted by episode and time. order: (N,) their indices; t: (N,) s; parts: episodes that are long enough."""

    order: NDArray[np.int64]
    t: Array
    parts: list[slice]

    @staticmethod
    def of(t: Array | None, episode: NDArray[Any]) -> _Course:
        places = np.arange(len(episode), dtype=np.float64)
        times = places if t is None else t
        order = np.lexsort((places, times, episode))
        edges = np.flatnonzero(np.diff(episode[order])) + 1
        bounds = [0, *edges.tolist(), len(order)]
        parts = [slice(a, b) for a, b in pairwise(bounds) if b - a >= OPTIONS.min_rows]
        return _Course(order, times[order], parts)

    def turning(self, dq: Array) -> Mask:
        """Return the rows (N,) beside which a velocity (N,) has another sign."""
        out = np.zeros(len(dq), np.bool_)
        sign = np.sign(dq[self.order])
        turns = sign[1:] != sign[:-1]
        out[self.order[1:]] |= turns
        out[self.order[:-1]] |= turns
        return out

    def measure(self, values: Array) -> tuple[Array, Array]:
        """Return the deviation of each value, in allowed deviations, and its change, in usual changes.

        Each is (N,), and 0 in episodes too short to compare.
        """
        far, change = np.zeros(len(values)), np.zeros(len(values))
        y = values[self.order]
        parts = [np.flatnonzero(np.isfinite(y[part]) & np.isfinite(self.t[part])) + part.start for part in self.parts]
        parts = [part for part in parts if len(part) >= OPTIONS.min_rows]
        if not parts:
            return far, change
        every = np.concatenate(parts)
        low, high = np.quantile(y[every], (0.02, 0.98))
        deviations = [deviation(self.t[part], y[part]) for part in parts]
        changes = [_change(y[part]) for part in parts]
        steps = np.concatenate(changes)
        quantum = float(np.quantile(steps[steps > 0], 0.1)) if (steps > 0).any() else np.inf
        floor = max(float(np.median(np.concatenate(deviations))), quantum)
        usual = max(float(np.quantile(steps, 0.6)), quantum)
        inner = slice(OPTIONS.end_rows, -OPTIONS.end_rows)
        for part, deviates, differs in zip(parts, deviations, changes, strict=True):
            least = OPTIONS.min_spread_share * (high - low)
            share = deviates / max(OPTIONS.max_deviations * floor + least, 1e-300)
            striking = np.flatnonzero(share > 1.0 / OPTIONS.lead)  # only these can be corrupt
            usual_there = np.maximum(_around(deviates, striking), floor)
            share[striking] = deviates[striking] / np.maximum(OPTIONS.max_deviations * usual_there + least, 1e-300)
            far[self.order[part[inner]]] = share[inner]
            change[self.order[part]] = differs / usual
        return far, change


def _change(y: Array) -> Array:
    """Return the largest distance of each value from those beside it, (N,)."""
    steps = np.abs(np.diff(y))
    return np.asarray(np.maximum(np.append(steps, 0.0), np.insert(steps, 0, 0.0)))


def deviation(t: Array, y: Array) -> Array:
    """Return the distance of each value from the nearest extrapolation or interpolation of its neighbours, (N,).

    Each side has two extrapolations: the nearest value itself, and the line through the two nearest values. The
    interpolations are the line through the two neighbours and the cubic through the four nearest values. t: (N,) s,
    rising; y: (N,).
    """
    best = np.full(len(y), np.inf)

    def compare(rows: slice, guess: Array) -> None:
        gap = np.abs(y[rows] - guess)
        best[rows] = np.minimum(best[rows], np.where(np.isfinite(gap), gap, np.inf))

    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        compare(slice(1, None), y[:-1])
        compare(slice(None, -1), y[1:])
        compare(slice(2, None), _through(t[2:], (t[:-2], y[:-2]), (t[1:-1], y[1:-1])))
        compare(slice(None, -2), _through(t[:-2], (t[1:-1], y[1:-1]), (t[2:], y[2:])))
        compare(slice(1, -1), _through(t[1:-1], (t[:-2], y[:-2]), (t[2:], y[2:])))
        four = [(t[at : len(t) - 4 + at], y[at : len(t) - 4 + at]) for at in (0, 1, 3, 4)]
        compare(slice(2, -2), _through(t[2:-2], *four))
    return best


def _through(at: Array, *points: tuple[Array, Array]) -> Array:
    """Return the values at `at` of the polynomials through points, each (times, values), all (N,): Lagrange's form."""
    total = np.zeros(len(at))
    for mine, (t, y) in enumerate(points):
        weight = np.ones(len(at))
        for other, (s, _) in enumerate(points):
            if other != mine:
                weight *= (at - s) / (t - s)
        total += weight * y
    return total


def _around(each: Array, rows: NDArray[np.int64]) -> Array:
    """Return the usual deviation around rows (M,), without each row and its nearest, from all deviations (N,): (M,)."""
    padded = np.pad(each, OPTIONS.neighbours, mode="reflect")
    offsets = [at for at in range(2 * OPTIONS.neighbours + 1) if abs(at - OPTIONS.neighbours) > OPTIONS.skipped]
    return np.asarray(
        np.quantile(
            sliding_window_view(padded, 2 * OPTIONS.neighbours + 1)[rows][:, offsets], OPTIONS.usual_quantile, axis=1
        )
    )


def _far(y: Array) -> Mask:
    """Return a mask of the values (N,) that are much farther from the median than all others."""
    known = np.isfinite(y)
    return _leading(
        np.where(known, np.abs(y - np.median(y[known])) if known.any() else 0.0, 0.0), 0.0, OPTIONS.far_ratio
    )


def _leading(sizes: Array, least: float, lead: float) -> Mask:
    """Return which of sizes (N,) are above `least` and at least `lead` times all others, if they are few: (N,)."""
    few = min(_max_corrupt_rows(len(sizes)), len(sizes) - 1)
    top = -np.partition(-sizes, few)[: few + 1]
    top = np.sort(top)[::-1]
    leading = np.flatnonzero((top[:-1] > least) & (top[:-1] > lead * top[1:]) & ((top[1:] > 0) | (least > 0)))
    return sizes >= top[leading[-1]] if len(leading) else np.zeros(len(sizes), np.bool_)


def _max_corrupt_rows(count: int) -> int:
    """Return how many of `count` rows may be corrupt by accident."""
    return max(OPTIONS.max_rows, round(OPTIONS.max_share * count))

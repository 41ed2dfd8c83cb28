"""Corrupt rows of a recording: numbers that no robot reaches, and rows that stick out of their course alone.

A flipped bit, a lost packet or a loose plug spoils a row or two, and one such row may spoil all that is learnt: its
square enters every sum. A real torque has neighbours. It may leap, as friction does where a joint turns back, or rise
within a row as a move begins; but then what follows, or what went before, goes on from it. A corrupt one fits neither
side.
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

LARGEST_TORQUE = 1e6
"""|tau| in N·m (N) that no robot reaches (the largest arms: some 1e4): a damaged number, not a torque. Its square would
drown whatever was summed before."""
LARGEST = {"q": 1e5, "dq": 1e4, "ddq": 1e6, "tau": LARGEST_TORQUE}
"""The same of what is measured besides: rad, rad/s, rad/s² (m, m/s, m/s²). Joints without end turn often."""


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
    """Nearest rows on either side that are not compared: the row spoils their deviation."""
    usual_quantile: float = 0.8
    """Quantile of the neighbours' deviations that counts as usual: two of 12 neighbours may be corrupt themselves."""
    max_deviations: float = 12.0
    """Max deviation of a row, in usual deviations there."""
    min_spread_share: float = 0.02
    """A deviation also exceeds this share of the column's spread (2nd to 98th percentile)."""
    end_rows: int = 3
    """First and last rows of an episode: only one side of their course is known."""
    min_rows: int = 12
    """Min rows of an episode whose course is known."""
    far_ratio: float = 30.0
    """Without a course a row is corrupt if it is this many times as far from the median as all others."""
    max_share: float = 0.02
    max_rows: int = 3
    """Max rows that are left out, as a share of the recording or a count, whichever is more: more is no accident."""
    max_usual_changes: float = 4.0
    """Motion explains a deviation of torque, and torque one of motion, from this many usual changes on, and more of it
    with their square."""
    lead: float = 4.0
    """A corrupt row deviates this many times as much as the next one: a motion that is sampled so seldom that its moves
    take one row has many such rows."""
    turn_factor: float = 20.0
    """Factor on a torque's allowed deviation where its joint turns back: friction leaps, and leaps back if two turns
    lie a row apart."""
    max_rounds: int = 3
    """Corrupt rows may hide each other: the remaining rows are checked again, at most this often."""


OPTIONS = OutlierOptions()


class CorruptError(ValueError):
    """So many rows are corrupt that it is no accident. field, value, expected: what is wrong."""

    def __init__(self, value: str, expected: str) -> None:
        super().__init__(f"rows are {value}, expected {expected}")
        self.field, self.value, self.expected = "rows", value, expected


@dataclass(frozen=True)
class Corrupt:
    """Rows that are left out. rows: (N,) whether each is; why: (N,) place of the reason in `REASONS`."""

    rows: Mask
    why: NDArray[np.int64]

    @property
    def count(self) -> int:
        """How many."""
        return int(np.count_nonzero(self.rows))

    @property
    def first(self) -> list[int]:
        """The first of them, counted from 0."""
        return [int(row) for row in np.flatnonzero(self.rows)[:10]]

    def report(self) -> dict[str, Any]:
        """For JSON: how many rows, the first of them (counted from 0), and how many for each reason."""
        reasons = {name: int(np.count_nonzero(self.why[self.rows] == at)) for at, name in enumerate(REASONS)}
        return {"rows": self.count, "first": self.first, "why": {name: many for name, many in reasons.items() if many}}

    def in_fit(self) -> dict[str, int | str]:
        """The same as entries of a fit's report, which holds numbers and texts; nothing where no row is corrupt."""
        if not self.count:
            return {}
        why = ", ".join(f"{many} by {name}" for name, many in self.report()["why"].items())
        first = ", ".join(map(str, self.first))
        return {"samples_corrupt": self.count, "corrupt": f"{why}; the first are rows {first}, counted from 0"}


REASONS = ("magnitude", "course")
"""Why a row is corrupt: a magnitude that no robot reaches, or a value that fits neither what went before nor what
follows, while what it depends on goes on as usual."""
Read = Callable[[str, int], Array]
"""Gives the column of a quantity of a joint, (N,)."""


def corrupt(
    t: Array | None, episode: NDArray[Any], n_joints: int, read: Read, quantities: Sequence[str] = tuple(LARGEST)
) -> Corrupt:
    """Find the corrupt rows of a recording.

    t: (N,) s, in any order, None where not known; episode: (N,), equal over one contiguous recording; read: a column of
    some quantities of q, dq, ddq and tau, NaN where missing; one at a time is in memory.
    Raise CorruptError where too many rows are corrupt, naming the first ones.
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
                impossible = np.abs(values) > LARGEST[name]
                far = _far(np.where(impossible, np.nan, values))
                why[far & ~rows] = apart
                rows |= impossible | far
            deviates, change = course.look(np.where(rows, np.nan, values))
            if name == "dq":
                turning = course.turning(values)
            elif name == "tau":
                deviates[turning] /= OPTIONS.turn_factor
            sides[name == "tau"].take(deviates, change)
        for side, other in ((True, False), (False, True)):
            explained = np.maximum(sides[other].change / OPTIONS.max_usual_changes, 1.0) ** 2
            alone = _leading(sides[side].deviation / explained, 1.0, OPTIONS.lead)
            why[alone & ~rows] = apart
            rows |= alone
        if (rows == before).all():
            break
    corrupt_rows = Corrupt(rows, why)
    most = _most(count)
    if corrupt_rows.count > most:
        first = ", ".join(str(each + 1) for each in corrupt_rows.first)
        raise CorruptError(
            f"{corrupt_rows.count} corrupt ones of {count}: the first are {first}, counted from 1", f"at most {most}"
        )
    return corrupt_rows


def of_samples(samples: Samples) -> Corrupt:
    """Find the corrupt rows of samples; raise as `corrupt` does."""
    return corrupt(
        samples.t, samples.episode, samples.n_joints, lambda name, joint: np.asarray(getattr(samples, name)[:, joint])
    )


def of_long(rows: int, take: Callable[[int, int], Samples], block: int = 50_000) -> Corrupt:
    """Find the corrupt rows of a recording that is not in memory, block by block; raise as `corrupt` does.

    take: gives its samples from one row to another, exclusive; block: rows that are checked together.
    """
    parts: list[Corrupt] = []
    overlap = 2 * OPTIONS.neighbours
    for first in range(0, rows, block):
        begin, end = max(0, first - overlap), min(rows, first + block + overlap)
        inner = slice(first - begin, min(first + block, rows) - begin)
        try:
            inner_rows = of_samples(take(begin, end))
        except CorruptError as error:
            raise CorruptError(f"from row {begin + 1} on {error.value}", error.expected) from None
        parts.append(Corrupt(inner_rows.rows[inner], inner_rows.why[inner]))
    return Corrupt(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("rows", "why")))


@dataclass(frozen=True)
class _Side:
    """Torque, or motion: of all its columns, how far rows deviate, in what is allowed, and how much they change, in
    what is usual: (N,) each."""

    deviation: Array
    change: Array

    def take(self, deviation: Array, change: Array) -> None:
        """Look at one more column."""
        np.maximum(self.deviation, deviation, out=self.deviation)
        np.maximum(self.change, change, out=self.change)


@dataclass(frozen=True)
class _Course:
    """How rows follow each other. order: (N,) by episode and time; t: (N,) in order; parts: of rows in order, those
    long enough."""

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
        """Rows (N,) beside which a velocity (N,) has another sign."""
        out = np.zeros(len(dq), np.bool_)
        sign = np.sign(dq[self.order])
        turns = sign[1:] != sign[:-1]
        out[self.order[1:]] |= turns
        out[self.order[:-1]] |= turns
        return out

    def look(self, values: Array) -> tuple[Array, Array]:
        """How far each value is from its course, as a share of what is allowed, and how much it differs from those
        beside it, in usual differences: (N,) each, 0 where the course tells nothing."""
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
            striking = np.flatnonzero(share > 1.0 / OPTIONS.lead)  # of the others it does not matter how far they are
            usual_there = np.maximum(_around(deviates, striking), floor)
            share[striking] = deviates[striking] / np.maximum(OPTIONS.max_deviations * usual_there + least, 1e-300)
            far[self.order[part[inner]]] = share[inner]
            change[self.order[part]] = differs / usual
        return far, change


def _change(y: Array) -> Array:
    """Largest distance of each value from those beside it, (N,)."""
    steps = np.abs(np.diff(y))
    return np.asarray(np.maximum(np.append(steps, 0.0), np.insert(steps, 0, 0.0)))


def deviation(t: Array, y: Array) -> Array:
    """How far each value is from what its neighbours make of it, (N,): the least distance to what goes on from the two
    before or the two after, straight or level, and to the line and the cubic through both sides.

    t: (N,) s, rising; y: (N,).
    """
    best = np.full(len(y), np.inf)

    def take(rows: slice, guess: Array) -> None:
        gap = np.abs(y[rows] - guess)
        best[rows] = np.minimum(best[rows], np.where(np.isfinite(gap), gap, np.inf))

    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        take(slice(1, None), y[:-1])
        take(slice(None, -1), y[1:])
        take(slice(2, None), _through(t[2:], (t[:-2], y[:-2]), (t[1:-1], y[1:-1])))
        take(slice(None, -2), _through(t[:-2], (t[1:-1], y[1:-1]), (t[2:], y[2:])))
        take(slice(1, -1), _through(t[1:-1], (t[:-2], y[:-2]), (t[2:], y[2:])))
        four = [(t[at : len(t) - 4 + at], y[at : len(t) - 4 + at]) for at in (0, 1, 3, 4)]
        take(slice(2, -2), _through(t[2:-2], *four))
    return best


def _through(at: Array, *points: tuple[Array, Array]) -> Array:
    """Values at `at` of the polynomials through points, each (times, values), all (N,): Lagrange's form."""
    total = np.zeros(len(at))
    for mine, (t, y) in enumerate(points):
        weight = np.ones(len(at))
        for other, (s, _) in enumerate(points):
            if other != mine:
                weight *= (at - s) / (t - s)
        total += weight * y
    return total


def _around(each: Array, rows: NDArray[np.int64]) -> Array:
    """Usual deviation (N,) around some rows (M,), but for the row itself and those nearest: (M,)."""
    padded = np.pad(each, OPTIONS.neighbours, mode="reflect")
    offsets = [at for at in range(2 * OPTIONS.neighbours + 1) if abs(at - OPTIONS.neighbours) > OPTIONS.skipped]
    return np.asarray(
        np.quantile(
            sliding_window_view(padded, 2 * OPTIONS.neighbours + 1)[rows][:, offsets], OPTIONS.usual_quantile, axis=1
        )
    )


def _far(y: Array) -> Mask:
    """Values (N,) that are far from the median, compared with all others."""
    known = np.isfinite(y)
    return _leading(
        np.where(known, np.abs(y - np.median(y[known])) if known.any() else 0.0, 0.0), 0.0, OPTIONS.far_ratio
    )


def _leading(sizes: Array, least: float, lead: float) -> Mask:
    """Of sizes (N,) those above `least` that are at least `lead` times all others, where they are few: (N,)."""
    few = min(_most(len(sizes)), len(sizes) - 1)
    top = -np.partition(-sizes, few)[: few + 1]
    top = np.sort(top)[::-1]
    leading = np.flatnonzero((top[:-1] > least) & (top[:-1] > lead * top[1:]) & ((top[1:] > 0) | (least > 0)))
    return sizes >= top[leading[-1]] if len(leading) else np.zeros(len(sizes), np.bool_)


def _most(count: int) -> int:
    """Rows of so many that may be corrupt by accident."""
    return max(OPTIONS.max_rows, round(OPTIONS.max_share * count))

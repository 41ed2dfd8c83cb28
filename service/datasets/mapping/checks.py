"""What makes the columns of a recording usable; each rule says what is wrong, and where."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from service.foundation.errors import InvalidDataError, invalid_data

MIN_SAMPLES = 30
"""Samples of a data set, at least."""


@dataclass(frozen=True)
class CheckOptions:
    """Limits of usable columns."""

    constant: float = 1e-6
    """Span in rad or m below which a joint has not moved."""
    moved: float = 0.01
    """Span in rad or m above which a joint that was left out has moved."""
    jump: float = 1.0
    """A position that jumps by a turn between two rows, within so many rad, was wrapped."""
    max_size: float = 1e12
    """Max size of a time, motion or torque in SI units; beyond it, squares and differences overflow."""
    max_step_s: float = 1.0
    """Max step of time of a robot, s; longer ones are in another unit."""
    window: int = 25
    """Rows over which a signal and its derivative are compared."""
    stretch: int = 20_000
    """Max rows at the start of a recording that are compared so."""
    correlation: float = 0.97
    """Min correlation at which such a comparison counts."""
    tolerance: float = 0.05
    """Max relative difference between a factor and that of a unit."""


CHECKS = CheckOptions()


Rows = NDArray[np.int64]


@dataclass
class Seen:
    """What was seen of a column, block after block: its range, the row of what is farthest from 0, what is missing."""

    name: str
    low: float = np.inf
    high: float = -np.inf
    far: float = 0.0
    far_row: int = 0
    missing: int = 0
    first_missing: int = 0

    def add(self, values: Array, rows: Rows) -> None:
        """Look at more values (M,), NaN where missing, of these rows; raise InvalidDataError where one is too large."""
        gone = np.isnan(values)
        if gone.any():
            self.first_missing = self.first_missing or int(rows[gone.argmax()])
            self.missing += int(gone.sum())
            values, rows = values[~gone], rows[~gone]
        if len(values) == 0:
            return
        size = np.abs(values)
        place = int(size.argmax())
        if size[place] > CHECKS.max_size:
            first = int((size > CHECKS.max_size).argmax())
            expected = f"SI units, within ±{CHECKS.max_size:g}"
            raise invalid_data(f"{self.name}, row {rows[first]}", str(values[first]), expected)
        if size[place] > abs(self.far):
            self.far, self.far_row = float(values[place]), int(rows[place])
        self.low, self.high = min(self.low, float(values.min())), max(self.high, float(values.max()))

    @property
    def span(self) -> float:
        """Largest less smallest value; 0 where there are none."""
        return max(0.0, self.high - self.low)


class Turns:
    """Takes jumps of a whole turn out of a joint's positions, block after block, as sensors wrap them at ±π or 2π.

    count: jumps so far; first: row of the first one, counted from 1.
    """

    def __init__(self) -> None:
        self.count, self.first = 0, 0
        self._last: tuple[float, float] | None = None
        self._turned = 0.0

    def unwrap(self, q: Array, episode: Array | None, rows: Rows) -> Array:
        """More positions (M,), rad, NaN where missing, of these rows, without jumps; each episode begins where it is
        recorded."""
        known = np.flatnonzero(~np.isnan(q))
        if len(known) == 0:
            return q
        values = q[known]
        numbers = np.zeros(len(known)) if episode is None else episode[known]
        last = self._last or (float(values[0]), float(numbers[0]))
        step, other = np.diff(values, prepend=last[0]), np.diff(numbers, prepend=last[1]) != 0
        jumps = np.where((np.abs(np.abs(step) - math.tau) < CHECKS.jump) & ~other, -np.sign(step), 0.0)
        self._last = float(values[-1]), float(numbers[-1])
        if jumps.any():
            self.first = self.first or int(rows[known[np.flatnonzero(jumps)[0]]])
            self.count += int(np.count_nonzero(jumps))
        elif not self._turned:
            return q
        turned = np.cumsum(jumps)
        begun = np.maximum.accumulate(np.where(other, np.arange(len(jumps)), -1))
        turned = np.where(begun < 0, turned + self._turned, turned - turned[np.maximum(begun, 0)])
        self._turned = float(turned[-1])
        out = q.copy()
        out[known] += math.tau * turned
        return out


class Clockwork:
    """Watches times over blocks: within an episode they may not go backwards; where they stand still is counted."""

    def __init__(self, name: str) -> None:
        self.name, self.repeated, self.first_repeated = name, 0, 0
        self._last: tuple[float, float] | None = None

    def look(self, t: Array, episode: Array | None, rows: Rows) -> None:
        """Look at more times (M,), NaN where missing; count those that were there before. Raise InvalidDataError."""
        known = np.flatnonzero(~np.isnan(t))
        if len(known) == 0:
            return
        times = t[known]
        numbers = np.zeros(len(known)) if episode is None else episode[known]
        if self._last is not None:
            times = np.concatenate([[self._last[0]], times])
            numbers = np.concatenate([[self._last[1]], numbers])
        self._last = float(times[-1]), float(numbers[-1])
        step = np.where(np.diff(numbers) == 0, np.diff(times), np.inf)
        after = known[len(known) - len(step) :]  # rows that the steps lead to
        if (back := np.flatnonzero(step < 0)).size:
            place = int(back[0])
            hint = (
                "" if episode is not None else "; or a column `episode` that numbers recordings, where a new one starts"
            )
            raise invalid_data(
                f"{self.name}, row {rows[after[place]]}",
                f"{times[place + 1]:.15g}",
                f"more than {times[place]:.15g}, the time before it{hint}",
            )
        again = after[step == 0]
        if len(again):
            self.first_repeated = self.first_repeated or int(rows[again[0]])
            self.repeated += len(again)


def check_episodes(values: Array, rows: Rows, name: str) -> None:
    """Raise InvalidDataError where a number of an episode is not whole."""
    wrong = ~np.isfinite(values) | (values != np.floor(values)) | (np.abs(values) > 2**53)
    if wrong.any():
        place = int(wrong.argmax())
        raise invalid_data(f"{name}, row {rows[place]}", float(values[place]), "a whole number")


def check_rows(rows: int, missing: int, repeated: int, least: int, seen: list[Seen]) -> None:
    """Raise InvalidDataError where too few rows are complete and have times of their own."""
    if 2 * missing > rows:
        worst = max(seen, key=lambda each: each.missing)
        raise invalid_data(
            f"{worst.name}, row {worst.first_missing}",
            f"not a finite number, nor in {worst.missing} of {rows} rows in all",
            "at most half of the rows with something missing",
        )
    usable = max(0, rows - missing - repeated)
    if usable < least:
        why = [f"{missing} with something missing"] if missing else []
        why += [f"{repeated} whose time was there before"] if repeated else []
        left_out = f", those left out {' and '.join(why)}" if why else ""
        raise invalid_data("rows", usable, f"at least {least} samples{left_out}")


def check_positions(seen: list[tuple[str, Seen]], max_position: float, certain: bool) -> None:
    """Raise InvalidDataError where positions are too large for SI units, unless these are certain, or a joint has not
    moved."""
    farthest = max((each for _, each in seen), key=lambda each: abs(each.far))
    if abs(farthest.far) > max_position and not certain:
        raise invalid_data(
            f"{farthest.name}, row {farthest.far_row}",
            f"{farthest.far:g}",
            f'radians (or metres) within ±{max_position:g}: are these degrees? Then say units={{"q": "deg"}}, or '
            'units={"q": "rad"} if joints turn on',
        )
    for joint, each in seen:
        if each.span < CHECKS.constant:
            raise invalid_data(
                each.name,
                f"constant at {each.low:g}",
                f"a joint that moves: leave out locked joints, drop_joints={joint}",
            )


def check_torques(seen: list[tuple[str, Seen]]) -> None:
    """Raise InvalidDataError where a torque is the same in all rows: nobody has measured it."""
    constant = [(joint, each) for joint, each in seen if each.span == 0]
    for joint, each in constant:
        hint = "" if len(constant) == len(seen) else f"; without any, leave it out: drop_joints={joint}"
        raise invalid_data(each.name, f"constant at {each.low:g}", f"torque measured while the joint moved{hint}")


def epoch_unit(t: Array, rows: Rows, name: str) -> None:
    """Raise InvalidDataError where times that nobody gave a unit are too large for seconds since whenever."""
    large = np.abs(t) > CHECKS.max_size
    if large.any():
        value = float(t[large.argmax()])
        unit = "ms" if abs(value) < 1e14 else "us" if abs(value) < 1e17 else "ns"  # since 1970
        raise invalid_data(f"{name}, row {rows[large.argmax()]}", f"{value:.15g}", _seconds(unit))


def _seconds(unit: str) -> str:
    return f'seconds, or its unit: units={{"t": "{unit}"}} if it is {unit}, units={{"t": "s"}} if it is s'


def check_time_unit(t: Array, given: bool, name: str) -> None:
    """Raise InvalidDataError where times can hardly be seconds; given: whether somebody says what they are."""
    step = np.diff(t[~np.isnan(t)])
    step = step[step > 0]
    usual = float(np.median(step)) if len(step) else 0.0
    if given or usual < CHECKS.max_step_s:
        return
    unit = "ms" if usual < 500 else "us" if usual < 500e3 else "ns"  # of rates from 2 to 1000 Hz
    raise invalid_data(name, f"in steps of {usual:g}", _seconds(unit))


UNITS_OF_RATIO: tuple[tuple[float, tuple[str, str] | None, tuple[str, str] | None], ...] = (
    (360 / math.tau, ("dq", "deg/s"), ("ddq", "deg/s^2")),
    (math.tau / 360, ("q", "deg"), ("dq", "deg/s")),
    (60 / math.tau, ("dq", "rpm"), None),
    (1 / math.tau, ("dq", "rev/s"), ("ddq", "rev/s^2")),
    (1000.0, ("dq", "mm/s"), ("ddq", "mm/s^2")),
    (1e-3, ("q", "mm"), ("dq", "mm/s")),
)
"""By how much a derivative is too large where it, or what it is of, is in another unit: for dq of q, for ddq of dq."""


def slope_ratio(t: Array, values: Array, derivative: Array) -> float | None:
    """How many times as large a derivative is as the slope of what it is of; None where the data cannot tell.

    All (M,), of one contiguous recording. Compares the change of `values` over some rows with the integral of the
    derivative, which noise hardly disturbs.
    """
    window = CHECKS.window
    if len(t) < 2 * window:
        return None
    steps = np.diff(t) * (derivative[1:] + derivative[:-1]) / 2
    integral = np.concatenate([[0.0], np.cumsum(steps)])
    expected, integrated = values[window:] - values[:-window], integral[window:] - integral[:-window]
    product, size, other = float(expected @ integrated), float(expected @ expected), float(integrated @ integrated)
    if not product**2 > CHECKS.correlation**2 * size * other:
        return None
    return product / size


def wrong_unit(ratios: list[float | None], derivative: str) -> InvalidDataError | None:
    """The error where ratios of joints say that a derivative, dq or ddq, and what it is of have units that differ."""
    known = [each for each in ratios if each is not None]
    if 2 * len(known) <= len(ratios):
        return None
    ratio = float(np.median(known))
    for value, of_dq, of_ddq in UNITS_OF_RATIO:
        hint = of_dq if derivative == "dq" else of_ddq
        if hint is not None and abs(ratio / value - 1) < CHECKS.tolerance:
            quantity, unit = hint
            return invalid_data(
                derivative,
                f"{ratio:.3g} times the slope of {'q' if derivative == 'dq' else 'dq'}",
                f'both in SI units; say units={{"{quantity}": "{unit}"}} if {quantity} is in {unit}',
            )
    return None


def first_stretch(t: Array, episode: Array | None, missing: NDArray[np.bool_]) -> slice:
    """The first contiguous rows of a recording, CHECKS.stretch at most, that is long enough to tell of its units."""
    breaks = missing[1:] | missing[:-1]
    if episode is not None:
        breaks |= np.diff(episode) != 0
    ends = np.concatenate([[0], np.flatnonzero(breaks) + 1, [len(t)]])
    lengths = np.diff(ends)
    long = np.flatnonzero(lengths >= 4 * CHECKS.window)
    place = int(long[0]) if len(long) else int(lengths.argmax())
    return slice(int(ends[place]), int(min(ends[place + 1], ends[place] + CHECKS.stretch)))

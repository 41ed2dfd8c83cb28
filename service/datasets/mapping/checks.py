"""Checks of a recording's columns; an error names the column and the row."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from service.datasets.staging import POSES_HINT
from service.foundation.errors import InvalidDataError, invalid_data
from service.foundation.text import counted

MIN_SAMPLES = 30
"""Min samples of a data set."""


@dataclass(frozen=True)
class CheckOptions:
    """Limits of the checks."""

    min_span: float = 1e-6
    """Min span of the positions of a joint, rad or m."""
    max_dropped_span: float = 0.01
    """Max span of the positions of a joint that is left out without a warning, rad or m."""
    turn_tolerance: float = 1.0
    """Max difference from a whole turn of a jump between two rows that is unwrapped, rad."""
    max_size: float = 1e12
    """Max absolute value of a time, motion or torque in SI units; larger squares and differences could overflow."""
    max_step_s: float = 1.0
    """Max usual time step, s; longer ones are in another unit."""
    slope_window: int = 25
    """Rows over which the change of a signal is compared with its derivative."""
    max_slope_rows: int = 20_000
    """Max rows at the start of a recording that are compared."""
    min_correlation: float = 0.97
    """Min correlation of a comparison that counts."""
    unit_tolerance: float = 0.05
    """Max relative difference between a ratio and the factor of a unit."""


CHECKS = CheckOptions()


Rows = NDArray[np.int64]


@dataclass
class ColumnStats:
    """Range, largest absolute value and missing values of a column, collected in blocks."""

    name: str
    low: float = np.inf
    high: float = -np.inf
    far: float = 0.0
    far_row: int = 0
    missing: int = 0
    first_missing: int = 0

    def add(self, values: Array, rows: Rows) -> None:
        """Add values (M,) of these rows, NaN if missing; raise InvalidDataError if one is too large."""
        missing = np.isnan(values)
        if missing.any():
            self.first_missing = self.first_missing or int(rows[missing.argmax()])
            self.missing += int(missing.sum())
            values, rows = values[~missing], rows[~missing]
        if len(values) == 0:
            return
        size = np.abs(values)
        place = int(size.argmax())
        if size[place] > CHECKS.max_size:
            first = int((size > CHECKS.max_size).argmax())
            expected = f"a value in SI units within ±{CHECKS.max_size:g}"
            raise invalid_data(f"{self.name}, row {rows[first]}", str(values[first]), expected)
        if size[place] > abs(self.far):
            self.far, self.far_row = float(values[place]), int(rows[place])
        self.low, self.high = min(self.low, float(values.min())), max(self.high, float(values.max()))

    @property
    def span(self) -> float:
        """Largest minus smallest value; 0 if there are none."""
        return max(0.0, self.high - self.low)


JointStats = tuple[str, list[ColumnStats]]
"""A joint and its columns."""


class TurnUnwrapper:
    """Removes jumps of a whole turn from a joint's positions, which sensors wrap at ±π or 2π.

    count: jumps so far; first: row of the first one, counted from 1.
    """

    def __init__(self) -> None:
        self.count, self.first = 0, 0
        self._last: tuple[float, float] | None = None
        self._turned = 0.0

    def unwrap(self, q: Array, episode: Array | None, rows: Rows) -> Array:
        """Return positions (M,) of these rows without jumps, rad; each episode starts at its recorded value."""
        known = np.flatnonzero(~np.isnan(q))
        if len(known) == 0:
            return q
        values = q[known]
        numbers = np.zeros(len(known)) if episode is None else episode[known]
        last = self._last or (float(values[0]), float(numbers[0]))
        step, other = np.diff(values, prepend=last[0]), np.diff(numbers, prepend=last[1]) != 0
        jumps = np.where((np.abs(np.abs(step) - math.tau) < CHECKS.turn_tolerance) & ~other, -np.sign(step), 0.0)
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


class TimeChecker:
    """Checks that times do not go back within an episode, and counts repeated ones."""

    def __init__(self, name: str) -> None:
        self.name, self.repeated, self.first_repeated = name, 0, 0
        self._last: tuple[float, float] | None = None

    def add(self, t: Array, episode: Array | None, rows: Rows) -> None:
        """Add times (M,), NaN if missing; raise InvalidDataError if they go back."""
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
        after = known[len(known) - len(step) :]  # the row at the end of each step
        if (back := np.flatnonzero(step < 0)).size:
            place = int(back[0])
            hint = "" if episode is not None else ". If a new recording starts here, add a column `episode`"
            raise invalid_data(
                f"{self.name}, row {rows[after[place]]}",
                f"{times[place + 1]:.15g}",
                f"more than {times[place]:.15g}, the time of the row before{hint}",
            )
        again = after[step == 0]
        if len(again):
            self.first_repeated = self.first_repeated or int(rows[again[0]])
            self.repeated += len(again)


def check_episodes(values: Array, rows: Rows, name: str) -> None:
    """Raise InvalidDataError if an episode number is not a whole number."""
    wrong = ~np.isfinite(values) | (values != np.floor(values)) | (np.abs(values) > 2**53)
    if wrong.any():
        place = int(wrong.argmax())
        raise invalid_data(f"{name}, row {rows[place]}", float(values[place]), "a whole number")


def check_rows(
    rows: int, missing: int, repeated: int, min_samples: int, time: ColumnStats | None, joints: list[JointStats]
) -> None:
    """Raise InvalidDataError if too few rows are complete and have a new time. joints: with their columns."""
    stats = [each for _, row in joints for each in row] + ([time] if time else [])
    if 2 * missing > rows:
        worst = max(stats, key=lambda each: each.missing)
        if empty := [joint for joint, row in joints if any(each.missing == rows for each in row)]:
            expected = f"numbers. Leave out joints without them with drop_joints={','.join(empty)}"
            raise invalid_data(worst.name, "missing in all rows", expected)
        raise invalid_data(
            f"{worst.name}, row {worst.first_missing}",
            f"not a finite number, as in {worst.missing} of {rows} rows",
            "a finite number in at least half of the rows",
        )
    usable = max(0, rows - missing - repeated)
    if usable < min_samples:
        why = [f"{missing} have missing values"] if missing else []
        why += [f"{repeated} repeat the time of the row before"] if repeated else []
        unused = f" Of {rows} rows, {' and '.join(why)}." if why else ""
        found, expected = counted(usable, "usable row"), f"at least {min_samples}"
        raise invalid_data("rows", usable, expected, f"The file has {found}, expected {expected}.{unused}")


def check_positions(stats: list[tuple[str, ColumnStats]], max_position: float, has_unit: bool) -> None:
    """Raise InvalidDataError if positions without a stated unit are too large for SI units, or a joint did not move."""
    farthest = max((each for _, each in stats), key=lambda each: abs(each.far))
    if abs(farthest.far) > max_position and not has_unit:
        raise invalid_data(
            f"{farthest.name}, row {farthest.far_row}",
            f"{farthest.far:g}",
            f'radians or metres within ±{max_position:g}. Set units={{"q": "deg"}} if these are degrees, or '
            'units={"q": "rad"} if the joint turns this far',
        )
    if locked := [(joint, each) for joint, each in stats if each.span < CHECKS.min_span]:
        hint = "" if len(locked) == len(stats) else f". Leave out locked joints with {_drop(locked)}"
        first = locked[0][1]
        raise invalid_data(first.name, f"constant at {first.low:g}", f"a joint that moves{hint}")


def check_torques(stats: list[tuple[str, ColumnStats]]) -> None:
    """Raise InvalidDataError if a torque is the same in all rows, because then it was not measured."""
    if constant := [(joint, each) for joint, each in stats if each.span == 0]:
        hint = "" if len(constant) == len(stats) else f". Leave out joints without one with {_drop(constant)}"
        first = constant[0][1]
        raise invalid_data(first.name, f"constant at {first.low:g}", f"a torque measured while the joint moved{hint}")


def _drop(joints: list[tuple[str, ColumnStats]]) -> str:
    return f"drop_joints={','.join(joint for joint, _ in joints)}"


def check_epoch_unit(t: Array, rows: Rows, name: str) -> None:
    """Raise InvalidDataError if times without a unit are too large for seconds since 1970."""
    large = np.abs(t) > CHECKS.max_size
    if large.any():
        value = float(t[large.argmax()])
        unit = "ms" if abs(value) < 1e14 else "us" if abs(value) < 1e17 else "ns"  # since 1970
        raise invalid_data(f"{name}, row {rows[large.argmax()]}", f"{value:.15g}", _seconds(unit))


def _seconds(unit: str) -> str:
    return f'seconds. Set units={{"t": "{unit}"}} if it is in {unit}, or units={{"t": "s"}} if it is in s'


def check_time_unit(t: Array, has_unit: bool, name: str) -> None:
    """Raise InvalidDataError if the time steps are too long for seconds; has_unit: whether a unit is stated."""
    step = np.diff(t[~np.isnan(t)])
    step = step[step > 0]
    usual = float(np.median(step)) if len(step) else 0.0
    if has_unit or usual < CHECKS.max_step_s:
        return
    unit = "ms" if usual < 500 else "us" if usual < 500e3 else "ns"  # for rates from 2 to 1000 Hz
    raise invalid_data(name, f"in steps of {usual:g}", f"{_seconds(unit)}{POSES_HINT}")


UNITS_OF_RATIO: tuple[tuple[float, tuple[str, str] | None, tuple[str, str] | None], ...] = (
    (360 / math.tau, ("dq", "deg/s"), ("ddq", "deg/s^2")),
    (math.tau / 360, ("q", "deg"), ("dq", "deg/s")),
    (60 / math.tau, ("dq", "rpm"), None),
    (1 / math.tau, ("dq", "rev/s"), ("ddq", "rev/s^2")),
    (1000.0, ("dq", "mm/s"), ("ddq", "mm/s^2")),
    (1e-3, ("q", "mm"), ("dq", "mm/s")),
)
"""Ratio of a derivative to the slope of its signal, and the wrong unit it indicates: for q and dq, for dq and ddq."""


def slope_ratio(t: Array, values: Array, derivative: Array) -> float | None:
    """Return the ratio of a derivative to the slope of its signal; None if their correlation is too low.

    All arrays (M,), from one contiguous recording. The change of `values` over some rows is compared with the integral
    of the derivative, which is robust to noise.
    """
    window = CHECKS.slope_window
    if len(t) < 2 * window:
        return None
    steps = np.diff(t) * (derivative[1:] + derivative[:-1]) / 2
    integral = np.concatenate([[0.0], np.cumsum(steps)])
    expected, integrated = values[window:] - values[:-window], integral[window:] - integral[:-window]
    product, size, other = float(expected @ integrated), float(expected @ expected), float(integrated @ integrated)
    if not product**2 > CHECKS.min_correlation**2 * size * other:
        return None
    return product / size


def find_unit_error(ratios: list[float | None], derivative: str) -> InvalidDataError | None:
    """Return the error if the ratios of the joints show that dq or ddq does not match the unit of its signal."""
    known = [each for each in ratios if each is not None]
    if 2 * len(known) <= len(ratios):
        return None
    ratio = float(np.median(known))
    for value, of_dq, of_ddq in UNITS_OF_RATIO:
        hint = of_dq if derivative == "dq" else of_ddq
        if hint is not None and abs(ratio / value - 1) < CHECKS.unit_tolerance:
            quantity, unit = hint
            return invalid_data(
                derivative,
                f"{ratio:.3g} times the slope of {'q' if derivative == 'dq' else 'dq'}",
                f'both in SI units. Set units={{"{quantity}": "{unit}"}} if {quantity} is in {unit}',
            )
    return None


def find_slope_rows(t: Array, episode: Array | None, missing: NDArray[np.bool_]) -> slice:
    """Return the first contiguous rows that are long enough to compare slopes, at most `max_slope_rows`."""
    breaks = missing[1:] | missing[:-1]
    if episode is not None:
        breaks |= np.diff(episode) != 0
    ends = np.concatenate([[0], np.flatnonzero(breaks) + 1, [len(t)]])
    lengths = np.diff(ends)
    long = np.flatnonzero(lengths >= 4 * CHECKS.slope_window)
    place = int(long[0]) if len(long) else int(lengths.argmax())
    return slice(int(ends[place]), int(min(ends[place + 1], ends[place] + CHECKS.max_slope_rows)))

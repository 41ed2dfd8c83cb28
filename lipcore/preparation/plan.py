"""The plan of a recipe for one recording: computed once from its times, then applied joint by joint."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.preparation import steps as record
from lipcore.preparation.causal import CausalFilter
from lipcore.preparation.filtering import (
    QUANTITIES,
    Filters,
    QuantityReader,
    ZeroPhase,
    list_derived,
    resolve_filters,
    should_low_pass,
    without_delay,
)
from lipcore.preparation.recipe import PreparationError, Recipe
from lipcore.preparation.resampling import Sampling, clock_of, grid, interpolate, interpolate_even, thin_positions

MAX_BRIDGED_PERIODS = 0.3
"""Max gap, in periods of the cut-off, that is bridged instead of split if signals are low-passed.

Splitting costs a period at either side. Measured on sums of sinusoids up to 1.6 Hz, cut-off 4 Hz, with white noise of
0.1 N·m on tau, as errors in the gap and elsewhere: at 30 Hz a gap of 67 ms (0.27 periods) leaves ddq at 3.4 and 3.2 %,
tau at 0.06 and 0.05 N·m; at 1 kHz one of 75 ms ddq at 0.7 % and 0.1 %, tau at 0.15 and 0.01 N·m, one of 125 ms 1.8 %
and 0.6 N·m.
"""


@dataclass(frozen=True)
class Stretch:
    """One contiguous part of a recording."""

    rows: slice
    """Its rows among the kept rows of the recording."""
    at: Array | None
    """Evenly spaced times, s, at which it is interpolated; None if its own times are evenly spaced."""
    inner: slice
    """Its samples without the ends that are cut off."""
    positions: NDArray[np.int64] | Array | None
    """Positions of the returned samples among `inner`; None if all are returned."""
    out: slice
    """Its samples among the returned ones."""

    def on_clock(self, values: Array, times: Array) -> Array:
        """Return the samples of this part on its even clock. values, times: (N,), of the kept rows."""
        part = values[self.rows]
        return part if self.at is None else interpolate(times[self.rows], part, self.at)

    def select_output(self, values: Array) -> Array:
        """Return the samples of this part that remain after trimming and thinning."""
        return values[self.inner] if self.positions is None else interpolate_at(values[self.inner], self.positions)


def interpolate_at(values: Array, positions: NDArray[np.int64] | Array) -> Array:
    """Return values (N,) at positions (M,), interpolated between samples unless these are integers."""
    if positions.dtype.kind == "i":
        return np.asarray(values[positions])
    return interpolate_even(values, np.asarray(positions, dtype=np.float64))


@dataclass(frozen=True)
class Plan:
    """The plan of a recipe for one recording, which returns M samples."""

    t: Array
    """Times of the samples, (M,) s, or row numbers from 0 if the recording has no times."""
    episode: NDArray[np.int64]
    """Part of each sample, (M,), from 0."""
    steps: list[record.Step]
    """Record of the steps, see `lipcore.preparation.steps`."""
    derived: tuple[str, ...]
    rate: float | None
    """Hz, None without times."""
    cutoff: float | None
    delay_s: float
    """Delay of the samples in a live stream."""
    resampled: bool
    gaps: int
    """Number of gaps at which the recording is split."""
    missing: int
    """Number of rows left out because of a missing value."""
    first_missing: int | None
    """The first of these rows, counted from 1."""
    repeated: int
    """Number of rows left out because of a repeated time."""
    edges: int
    """Number of samples cut off at the ends of parts."""
    _kept: NDArray[np.bool_] | None
    _times: Array
    _parts: list[Stretch]
    _work: Filters | None
    _causal: CausalFilter | None
    _low_pass: ZeroPhase | None

    def __len__(self) -> int:
        return len(self.t)

    @property
    def episodes(self) -> int:
        """Return the number of parts."""
        return len(self._parts)

    def apply(self, joint: Mapping[str, Array]) -> dict[str, Array]:
        """Return q, dq, ddq, tau, (M,) each, of one joint from its recorded quantities, (N,) each."""
        return dict(self.columns(joint.__getitem__))

    def columns(self, read: QuantityReader) -> Iterator[tuple[str, Array]]:
        """Yield the same, one quantity after the other: of a recording in one part, only one is in memory at a time."""

        def kept(name: str) -> Array:
            return read(name) if self._kept is None else read(name)[self._kept]

        if len(self._parts) == 1:
            part = self._parts[0]
            for name, values in self._of(part, kept):
                yield name, part.select_output(values)
            return
        given = QUANTITIES if self._work is None else self._work.given
        signals = {name: kept(name) for name in given}
        columns = {name: np.empty(len(self.t)) for name in QUANTITIES}
        for part in self._parts:
            for name, values in self._of(part, signals.__getitem__):
                columns[name][part.out] = part.select_output(values)
        for name in QUANTITIES:
            yield name, columns.pop(name)

    def _of(self, part: Stretch, read: QuantityReader) -> Iterator[tuple[str, Array]]:
        """Yield the samples of one part, before its ends are cut off."""

        def samples(name: str) -> Array:
            return part.on_clock(read(name), self._times)

        if self._work is None:
            yield from ((name, samples(name)) for name in QUANTITIES)
        elif self._causal is None:
            yield from without_delay(samples, self._work, self._low_pass)
        else:
            yield from self._causal.part(samples)


@dataclass(frozen=True)
class _Rows:
    """The rows that are used."""

    t: Array
    """(M,) s, or row numbers without times."""
    episode: Array
    kept: NDArray[np.bool_] | None
    """Mask of the used rows among all, (N,), None if all are used."""
    apart: NDArray[np.bool_] | None
    """Whether rows are missing between two neighbouring rows without times, (M - 1,)."""
    missing: int
    first_missing: int | None
    repeated: int


def plan(
    t: Array | None,
    episode: Array | None,
    missing: NDArray[np.bool_],
    given: tuple[str, ...],
    recipe: Recipe,
    corrupt: NDArray[np.bool_] | None = None,
    braked: NDArray[np.bool_] | None = None,
) -> Plan:
    """Return the plan of the recipe for a recording of N rows.

    t: (N,) s, rising within an episode, None if not recorded; episode: (N,) numbers, None if there is only one;
    missing: (N,) mask of rows with an unknown time or value; given: recorded ones of q, dq, ddq, tau; corrupt, braked:
    (N,) masks of other rows to leave out before a filter spreads them (`lipcore.data.outliers`, `brakes`).

    Raise PreparationError if the recording does not allow the recipe.
    """
    given = tuple(name for name in QUANTITIES if name in given)
    to_derive = list_derived(given)
    steps: list[record.Step] = []
    damaged = np.zeros_like(missing) if corrupt is None else corrupt & ~missing
    held = np.zeros_like(missing) if braked is None else braked & ~missing & ~damaged
    rows = _rows(t, episode, missing, {"corrupt": damaged, "braked": held}, steps)
    if t is None:
        _check_times_are_not_needed(given, to_derive, recipe)
        changes = np.diff(rows.episode) != 0
        ends = changes if rows.apart is None else changes | rows.apart
        clock, work, resamples = None, None, False
    else:
        bridge = MAX_BRIDGED_PERIODS / recipe.cutoff_hz if should_low_pass(given, recipe) else 0.0
        clock = clock_of(rows.t, rows.episode, recipe.gap_steps, recipe.jitter, bridge)
        ends = clock.ends
        work = resolve_filters(1 / clock.usual, given, recipe)
        resamples = work.needs_even_steps and not clock.even
        if resamples:
            work = resolve_filters(clock.rate, given, recipe)
    if (changes_of_episode := int(np.count_nonzero(np.diff(rows.episode)))) > 0:
        steps.append(record.describe_episode_split(changes_of_episode + 1))
    if clock is not None and clock.gaps:
        steps.append(record.describe_gap_split(clock.gaps, clock.longest))
    if clock is not None and work is not None and resamples:
        steps.append(record.describe_resampling(work.rate, clock.worst, clock.longest))
    return _lay_out(rows, ends, clock, work, resamples, to_derive, steps)


def _rows(
    t: Array | None,
    episode: Array | None,
    missing: NDArray[np.bool_],
    unusable: Mapping[str, NDArray[np.bool_]],
    steps: list[record.Step],
) -> _Rows:
    """Return the rows that are neither missing nor unusable, by reason, without repeated times."""
    numbers = np.zeros(len(missing)) if episode is None else episode
    count = int(missing.sum())
    first = int(missing.argmax()) + 1 if count else None
    if first is not None:
        steps.append(record.describe_rows_left_out("missing", count, first))
    kept = ~missing
    for why, mask in unusable.items():
        kept &= ~mask
        if mask.any():
            steps.append(record.describe_rows_left_out(why, int(mask.sum()), int(mask.argmax()) + 1))
    repeated = 0
    if t is not None:
        places = np.flatnonzero(kept)
        step = np.diff(t[places])
        same = np.diff(numbers[places]) == 0
        if len(back := np.flatnonzero(same & (step < 0))):
            row = places[back[0] + 1]
            before = f"at least {t[places[back[0]]]:g}, the time before it"
            raise PreparationError(f"t, row {row + 1}", f"{t[row]:g}", before)
        again = places[1:][same & (step == 0)]
        if repeated := len(again):
            kept[again] = False
            steps.append(record.describe_rows_left_out("repeated", repeated, int(again[0]) + 1))
    if not kept.any():
        raise PreparationError("rows", 0, "at least one row without missing values")
    times = np.arange(len(kept), dtype=np.float64) if t is None else t
    if kept.all():
        return _Rows(times, numbers, None, None, 0, None, 0)
    times, numbers = times[kept], numbers[kept]
    apart = np.diff(times) > 1 if t is None else None
    return _Rows(times, numbers, kept, apart, count, first, repeated)


def _check_times_are_not_needed(given: tuple[str, ...], to_derive: tuple[str, ...], recipe: Recipe) -> None:
    if to_derive:
        why = f"{' and '.join(to_derive)} must be derived"
    elif should_low_pass(given, recipe):
        why = "signals are to be low-passed"
    elif recipe.rate_hz is not None:
        why = f"a rate of {recipe.rate_hz:g} Hz is requested"
    elif recipe.trim_s:
        why = "the ends of the recording are to be cut off"
    else:
        return
    raise PreparationError("t", "missing", f"times, because {why}")


def _lay_out(
    rows: _Rows,
    ends: NDArray[np.bool_],
    clock: Sampling | None,
    work: Filters | None,
    resamples: bool,
    to_derive: tuple[str, ...],
    steps: list[record.Step],
) -> Plan:
    """Return the plan: which samples of every contiguous part remain, and their place among all."""
    causal = CausalFilter(work, 1) if work is not None and work.form == "causal" else None
    late, lag = (0.0, 0) if causal is None else (causal.delay_s, causal.lag)
    bounds = [0, *(np.flatnonzero(ends) + 1).tolist(), len(rows.t)]
    parts: list[Stretch] = []
    times: list[Array] = []
    out = edges = 0
    for begin, end in pairwise(bounds):
        at = None
        t = rows.t[begin:end]
        if work is None:
            first, last, positions = 0, len(t), None
        else:
            if resamples:
                t = at = grid(float(t[0]), float(t[-1]), work.rate)
            first, last = work.edges[0], len(t) - 2 * lag - work.edges[1]
            if len(t) < work.shortest + 2 * lag:
                edges += len(t)
                continue
            edges += len(t) - (last - first)
            t = (t[lag : len(t) - lag] - late + lag / work.rate)[first:last] if causal else t[first:last]
            positions = thin_positions(len(t), work.every) if work.every > 1 else None
            t = t if positions is None else interpolate_at(t, positions)
        parts.append(Stretch(slice(begin, end), at, slice(first, last), positions, slice(out, out + len(t))))
        times.append(t)
        out += len(t)
    if work is not None and not parts:
        raise PreparationError("rows", len(rows.t), _long_enough(work))
    rate = None
    if work is not None:
        by_rows = parts[0].positions is None or parts[0].positions.dtype.kind == "i"
        rate = work.rate / (round(work.every) if by_rows else work.every)
        steps += _work_steps(work, late, edges, rate)
    return Plan(
        np.concatenate(times),
        np.repeat(np.arange(len(parts)), [len(each) for each in times]),
        steps,
        to_derive,
        rate,
        None if work is None else work.cutoff,
        late,
        resamples,
        0 if clock is None else clock.gaps,
        rows.missing,
        rows.first_missing,
        rows.repeated,
        edges,
        rows.kept,
        rows.t,
        parts,
        work,
        causal,
        None if work is None or work.cutoff is None else ZeroPhase(work.rate, work.cutoff),
    )


def _work_steps(work: Filters, late: float, edges: int, rate: float) -> list[record.Step]:
    steps = []
    if work.cutoff is not None:
        steps.append(record.describe_low_pass(work, late))
    if work.derived:
        steps.append(record.describe_differentiation(work))
    if work.cutoff is not None or edges:
        steps.append(record.describe_trimming(work, edges))
    if work.every > 1:
        steps.append(record.describe_thinning(work, rate))
    return steps


def _long_enough(work: Filters) -> str:
    what = f"filter at {work.cutoff:g} Hz" if work.cutoff is not None else "use"
    least = f"{work.shortest} samples, {work.shortest / work.rate:.3g} s"
    return f"a contiguous part long enough to {what}: at least {least}"

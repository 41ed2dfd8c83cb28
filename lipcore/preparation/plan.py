"""What a recipe does to one recording: worked out once from its times, then applied to one joint after the other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.preparation import steps as record
from lipcore.preparation.causal import CausalFilter
from lipcore.preparation.filtering import QUANTITIES, Filters, Read, ZeroPhase, derived, filters, settle, without_delay
from lipcore.preparation.recipe import PreparationError, Recipe
from lipcore.preparation.resampling import Sampling, between, clock_of, grid, interpolate, thinned

BRIDGE = 0.3
"""Longest gap, in periods of the cut-off, that is bridged rather than split at where signals are low-passed.

Splitting costs a period at either side. Measured on sums of sinusoids up to 1.6 Hz, cut-off 4 Hz, with white noise of
0.1 N·m on tau, as errors in the gap and elsewhere: at 30 Hz a gap of 67 ms (0.27 periods) leaves ddq at 3.4 and 3.2 %,
tau at 0.06 and 0.05 N·m; at 1 kHz one of 75 ms ddq at 0.7 % and 0.1 %, tau at 0.15 and 0.01 N·m, one of 125 ms 1.8 %
and 0.6 N·m.
"""


@dataclass(frozen=True)
class Stretch:
    """One contiguous part of a recording.

    rows: of those kept; at: even times it is put on, None where its own are even; inner: samples between the ends that
    are cut off; taken: positions among those, all where None; out: where they come to lie.
    """

    rows: slice
    at: Array | None
    inner: slice
    taken: NDArray[np.int64] | Array | None
    out: slice

    def on_clock(self, values: Array, times: Array) -> Array:
        """Of a column (N,) of the rows kept, with their times (N,), the samples of this part on its even clock."""
        part = values[self.rows]
        return part if self.at is None else interpolate(times[self.rows], part, self.at)

    def coming_out(self, values: Array) -> Array:
        """Of samples of this part, those that come out."""
        return values[self.inner] if self.taken is None else taken_at(values[self.inner], self.taken)


def taken_at(values: Array, positions: NDArray[np.int64] | Array) -> Array:
    """Values (N,) at whole positions (M,), or between them."""
    if positions.dtype.kind == "i":
        return np.asarray(values[positions])
    return between(values, np.asarray(positions, dtype=np.float64))


@dataclass(frozen=True)
class Plan:
    """What comes out of a recording, M samples, and how.

    t: (M,) s, the moments they tell of; counted from 0 where the recording has no times; episode: (M,) parts, from 0;
    steps: what is done, see `steps`; rate: Hz, None without times; delay_s: by which
    a live stream would have them late; gaps: where the recording is split; missing, first_missing (from 1), repeated:
    rows left out; edges: samples cut off.
    """

    t: Array
    episode: NDArray[np.int64]
    steps: list[record.Step]
    derived: tuple[str, ...]
    rate: float | None
    cutoff: float | None
    delay_s: float
    resampled: bool
    gaps: int
    missing: int
    first_missing: int | None
    repeated: int
    edges: int
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
        """Number of parts that come out."""
        return len(self._parts)

    def apply(self, joint: Mapping[str, Array]) -> dict[str, Array]:
        """Of one joint: the quantities given, (N,) each, to all of q, dq, ddq, tau, (M,) each."""
        return dict(self.columns(joint.__getitem__))

    def columns(self, read: Read) -> Iterator[tuple[str, Array]]:
        """The same, one quantity after the other: of a recording in one part, no more than one is held at a time."""

        def kept(name: str) -> Array:
            return read(name) if self._kept is None else read(name)[self._kept]

        if len(self._parts) == 1:
            part = self._parts[0]
            for name, values in self._of(part, kept):
                yield name, part.coming_out(values)
            return
        given = QUANTITIES if self._work is None else self._work.given
        signals = {name: kept(name) for name in given}
        columns = {name: np.empty(len(self.t)) for name in QUANTITIES}
        for part in self._parts:
            for name, values in self._of(part, signals.__getitem__):
                columns[name][part.out] = part.coming_out(values)
        for name in QUANTITIES:
            yield name, columns.pop(name)

    def _of(self, part: Stretch, read: Read) -> Iterator[tuple[str, Array]]:
        """Samples of one part, before its ends are cut off."""

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
    """The rows that are worked on. t, episode: of these; kept: (N,) where some are left out, else None; apart: (M - 1,)
    where rows between two of them are missing and no times tell.
    """

    t: Array
    episode: Array
    kept: NDArray[np.bool_] | None
    apart: NDArray[np.bool_] | None
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
) -> Plan:
    """Work out what the recipe does to a recording of N rows.

    t: (N,) s, rising within an episode, None where not recorded; episode: (N,) numbers, None where there is one;
    missing: (N,) rows that are to be left out, t or a value being unknown; given: of q, dq, ddq, tau, those recorded;
    corrupt: (N,) other rows that are to be left out (`data.outliers`), before a filter spreads them.
    Raise PreparationError where the recording does not allow what the recipe asks for.
    """
    given = tuple(name for name in QUANTITIES if name in given)
    to_derive = derived(given)
    steps: list[record.Step] = []
    damaged = np.zeros_like(missing) if corrupt is None else corrupt & ~missing
    rows = _rows(t, episode, missing, damaged, steps)
    if t is None:
        _check_times_are_not_needed(given, to_derive, recipe)
        changes = np.diff(rows.episode) != 0
        ends = changes if rows.apart is None else changes | rows.apart
        clock, work, resamples = None, None, False
    else:
        bridge = BRIDGE / recipe.cutoff_hz if filters(given, recipe) else 0.0
        clock = clock_of(rows.t, rows.episode, recipe.gap_steps, recipe.jitter, bridge)
        ends = clock.ends
        work = settle(1 / clock.usual, given, recipe)
        resamples = work.needs_even_steps and not clock.even
        if resamples:
            work = settle(clock.rate, given, recipe)
    if (changes_of_episode := int(np.count_nonzero(np.diff(rows.episode)))) > 0:
        steps.append(record.split_by_episodes(changes_of_episode + 1))
    if clock is not None and clock.gaps:
        steps.append(record.split_at_gaps(clock.gaps, clock.longest))
    if clock is not None and work is not None and resamples:
        steps.append(record.resampled(work.rate, clock.worst, clock.longest))
    return _lay_out(rows, ends, clock, work, resamples, to_derive, steps)


def _rows(
    t: Array | None,
    episode: Array | None,
    missing: NDArray[np.bool_],
    corrupt: NDArray[np.bool_],
    steps: list[record.Step],
) -> _Rows:
    """Leave out rows that are missing or corrupt, and those whose time was there before."""
    numbers = np.zeros(len(missing)) if episode is None else episode
    count = int(missing.sum())
    first = int(missing.argmax()) + 1 if count else None
    if first is not None:
        steps.append(record.left_out("missing", count, first))
    if corrupt.any():
        steps.append(record.left_out("corrupt", int(corrupt.sum()), int(corrupt.argmax()) + 1))
    kept = ~(missing | corrupt)
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
            steps.append(record.left_out("repeated", repeated, int(again[0]) + 1))
    if not kept.any():
        raise PreparationError("rows", 0, "rows without missing values")
    times = np.arange(len(kept), dtype=np.float64) if t is None else t
    if kept.all():
        return _Rows(times, numbers, None, None, 0, None, 0)
    times, numbers = times[kept], numbers[kept]
    apart = np.diff(times) > 1 if t is None else None
    return _Rows(times, numbers, kept, apart, count, first, repeated)


def _check_times_are_not_needed(given: tuple[str, ...], to_derive: tuple[str, ...], recipe: Recipe) -> None:
    if to_derive:
        why = f"{' and '.join(to_derive)} must be derived"
    elif filters(given, recipe):
        why = "signals are to be low-passed"
    elif recipe.rate_hz is not None:
        why = f"a rate of {recipe.rate_hz:g} Hz is asked for"
    elif recipe.trim_s:
        why = "the ends of the recording are to be cut off"
    else:
        return
    raise PreparationError("t", "missing", f"times, since {why}")


def _lay_out(
    rows: _Rows,
    ends: NDArray[np.bool_],
    clock: Sampling | None,
    work: Filters | None,
    resamples: bool,
    to_derive: tuple[str, ...],
    steps: list[record.Step],
) -> Plan:
    """Say for every contiguous part what of it comes out, and where it comes to lie."""
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
            first, last, taken = 0, len(t), None
        else:
            if resamples:
                t = at = grid(float(t[0]), float(t[-1]), work.rate)
            first, last = work.edges[0], len(t) - 2 * lag - work.edges[1]
            if len(t) < work.shortest + 2 * lag:
                edges += len(t)
                continue
            edges += len(t) - (last - first)
            t = (t[lag : len(t) - lag] - late + lag / work.rate)[first:last] if causal else t[first:last]
            taken = thinned(len(t), work.every) if work.every > 1 else None
            t = t if taken is None else taken_at(t, taken)
        parts.append(Stretch(slice(begin, end), at, slice(first, last), taken, slice(out, out + len(t))))
        times.append(t)
        out += len(t)
    if work is not None and not parts:
        raise PreparationError("rows", len(rows.t), _long_enough(work))
    rate = None
    if work is not None:
        by_rows = parts[0].taken is None or parts[0].taken.dtype.kind == "i"
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
        steps.append(record.low_passed(work, late))
    if work.derived:
        steps.append(record.differentiated(work))
    if work.cutoff is not None or edges:
        steps.append(record.trimmed(work, edges))
    if work.every > 1:
        steps.append(record.thinned(work, rate))
    return steps


def _long_enough(work: Filters) -> str:
    what = f"filter at {work.cutoff:g} Hz" if work.cutoff is not None else "use"
    least = f"{work.shortest} samples, {work.shortest / work.rate:.3g} s"
    return f"a contiguous part long enough to {what}: at least {least}"

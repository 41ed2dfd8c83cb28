"""Track the payload of one stream row by row: pick-up, estimate, put-down, and declaration by a user."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lipcore.data.motion import spaced_rows
from lipcore.data.samples import Array
from lipcore.model.body import Body
from lipcore.model.payload import Carrier, LinearisedCarrier, PayloadPosterior
from lipcore.online.batch import Rows
from lipcore.online.payload.bodies import ANY_PAYLOAD, ETA_STD
from lipcore.online.payload.held import TrackedPayload, no_rows
from lipcore.online.payload.hypotheses import WINDOW, Cell, CellWindow, cells_of, split_cells
from lipcore.online.payload.verdict import PRIOR, VERDICT, Gains, classify_state, find_pickup, probabilities
from lipcore.robots.urdf import PARAMETERS
from lipcore.vocabulary import PayloadState


@dataclass(frozen=True)
class TrackerOptions:
    """Cells that are judged, and how long states last."""

    sparse: tuple[int, ...] = (2, 4)
    """If a suspected contact lasts, one in this many cells is compared."""
    together: int = 3
    together_in_bulk: int = 6
    """Cells of one batch that are judged together: `together`, or `together_in_bulk` for batches with more cells than
    that. An instant within the last cells is still found."""
    cell_rows: int = 5
    """Max rows of a cell, evenly spread: a robot moves little within a cell, at any sampling rate."""
    max_stds: float = 2.5
    """Max deviation from the prior of payloads, in standard deviations. A body beyond it is implausible: heavier than
    20 kg, or with its centre of mass further than 0.37 m from the last link's frame. An external torque may look like
    one."""
    max_off: int = 12
    """Max successive cells, 0.6 s, that the payload does not explain. Then it is estimated again from them."""
    gap_s: float = 0.5
    """After a longer time between two rows, later rows are not compared with earlier ones."""
    settled_s: float = 1.0
    """A contact, or changed friction, is reported at once; another state only after rows have shown it for so long."""
    back_s: float = 60.0
    """Rows that are older than the latest by more show that a clock was set back: tracking starts again."""


OPTIONS = TrackerOptions()


@dataclass(frozen=True, eq=False)
class PayloadTracker:
    """The payload of one stream; immutable."""

    n: int
    """Number of joints."""
    state: PayloadState = "none"
    """What the last cells show."""
    probabilities: Mapping[str, float] | None = None
    """Probability of each hypothesis."""
    since: float | None = None
    """Event time, s, at which a payload was last picked up or put down."""
    held: TrackedPayload | None = None
    """The payload that the arm carries."""
    waiting: Rows | None = None
    """Rows that do not fill a cell yet."""
    recent: tuple[Rows, ...] = ()
    """Rows of the last cells."""
    cells: tuple[Cell, ...] = ()
    """The last cells, linearised by `around`."""
    around: LinearisedCarrier | None = None
    """Torque linearised around the current payload."""
    off: int = 0
    """Number of successive cells that the payload does not explain."""
    unsettled: float | None = None
    """Event time, s, since when the cells show another state; None if they do not."""

    def step(self, carrier: Carrier, rows: Rows) -> PayloadTracker:
        """Return the tracker after rows in order of event time. Rows older than the latest are ignored."""
        watch = self._adapt_to(carrier)
        assert watch.around is not None
        carrier = watch.around.carrier
        if watch._last is not None and len(rows) and rows.time[-1] < watch._last - OPTIONS.back_s:
            watch = replace(watch, waiting=None, recent=(), cells=())
        if watch._last is not None:
            rows = rows.take(rows.time > watch._last)
        if not len(rows):
            return watch
        for places in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(rows.time) > OPTIONS.gap_s) + 1):
            part = rows.take(places)
            last = watch._last
            if last is not None and part.time[0] - last > OPTIONS.gap_s:
                watch = replace(watch, waiting=None, recent=(), cells=())
            watch = watch._follow_run(carrier, part)
        return watch

    def declare(self, carrier: Carrier, body: Body, at: float) -> PayloadTracker:
        """Return the tracker with a payload declared from event time `at`, s."""
        return PayloadTracker(self.n, "payload", {"payload": 1.0}, at, TrackedPayload.of_declaration(carrier, body, at))

    def put_down(self, at: float) -> PayloadTracker:
        """Return the tracker without a payload, as declared from event time `at`, s."""
        return PayloadTracker(self.n, since=at)

    @property
    def load(self) -> PayloadPosterior | None:
        """Return the payload; None if there is none."""
        return None if self.held is None else self.held.estimate.load

    @property
    def _last(self) -> float | None:
        latest = self.waiting if self.waiting is not None else self.recent[-1] if self.recent else None
        return None if latest is None else float(latest.time[-1])

    def _adapt_to(self, carrier: Carrier) -> PayloadTracker:
        """Return the tracker for another revision of the model."""
        if self.around is None:
            return self._relinearise(carrier)
        if self.around.carrier.has_same_posterior(carrier):
            return self
        return replace(self, held=None if self.held is None else self.held.adapt_to(carrier))._relinearise(carrier)

    def _relinearise(self, carrier: Carrier) -> PayloadTracker:
        """Return the tracker with its cells linearised around the current payload."""
        load = carrier.known(np.zeros(PARAMETERS)) if self.load is None else self.load
        around = LinearisedCarrier(carrier, load)
        return replace(self, around=around, cells=cells_of(around, self.recent) if self.recent else ())

    def _follow_run(self, carrier: Carrier, rows: Rows) -> PayloadTracker:
        """Return the tracker after rows without a gap."""
        if self.waiting is not None:
            rows = Rows.concatenate([self.waiting, rows])
        # half a step before the end, because times jitter
        step = float(np.median(np.diff(rows.time))) if len(rows) > 1 else 0.0
        ends, first = [], 0
        while first < len(rows):
            until = rows.time[first] + WINDOW.cell_s - 0.5 * step
            last = max(int(np.searchsorted(rows.time, until, side="left")), first + 1)
            if last == len(rows) and rows.time[-1] + step < until:
                break
            ends.append((first, last))
            first = last
        parts = [rows.take(spaced_rows(last - first, OPTIONS.cell_rows, first)) for first, last in ends]
        watch = replace(self, waiting=rows.take(slice(first, None)) if first < len(rows) else None)
        together = OPTIONS.together if len(parts) <= OPTIONS.together_in_bulk else OPTIONS.together_in_bulk
        for at in range(0, len(parts), together):
            watch = watch._judge_cells(carrier, parts[at : at + together])
        return watch

    def _judge_cells(self, carrier: Carrier, parts: Sequence[Rows]) -> PayloadTracker:
        """Add cells and judge the last ones."""
        assert self.around is not None
        parts, new = split_cells(self.around, parts)
        kept = WINDOW.cells * OPTIONS.sparse[-1] if self.held is None else WINDOW.cells
        cells = (*self.cells, *new)[-kept:]
        watch = replace(self, recent=(*self.recent, *parts)[-kept:], cells=cells)
        if len(cells) <= WINDOW.min_before:
            return watch if watch.held is None else watch._estimate_from(carrier, parts)
        window = CellWindow.of(self.around, cells[-WINDOW.cells :])
        # an arm without a known payload may have carried one since before the first cell
        gains = window.gains((*WINDOW.after, WINDOW.cells) if self.held is None else WINDOW.after)
        watch = replace(watch, probabilities=probabilities(gains))
        return (
            watch._judge_unloaded(carrier, window, gains)
            if self.held is None
            else watch._judge_loaded(carrier, parts, window, gains)
        )

    def _estimate_from(self, carrier: Carrier, parts: Sequence[Rows]) -> PayloadTracker:
        """Estimate the payload from more rows."""
        assert self.held is not None
        held = self.held.add_rows(carrier, Rows.concatenate(parts))
        watch = replace(self, held=held)._with_state("payload")
        return watch if held.estimate is self.held.estimate else watch._relinearise(carrier)

    def _judge_unloaded(self, carrier: Carrier, window: CellWindow, gains: Gains) -> PayloadTracker:
        """Judge the cells of an arm without a known payload."""
        if (after := find_pickup(window, gains)) is not None:
            return self._pick_up(carrier, after)
        state = classify_state(gains)
        if state == "contact":  # it may be a payload too heavy for the arm's accuracy: a payload lasts
            assert self.around is not None
            for every in OPTIONS.sparse:
                cells = self.cells[(len(self.cells) - 1) % every :: every][-WINDOW.cells :]
                if len(cells) < VERDICT.lasting_cells + WINDOW.min_before:
                    break
                window = CellWindow.of(self.around, cells)
                if (after := find_pickup(window, window.gains(), every=every)) is not None:
                    return self._pick_up(carrier, every * after, every)
        return self._with_state(state)

    def _with_state(self, state: PayloadState) -> PayloadTracker:
        """Return the tracker after cells that show a state."""
        if state == self.state:
            return replace(self, unsettled=None)
        at = float(self.recent[-1].time[-1])
        if self.state in ("none", "payload") or (
            self.unsettled is not None and at - self.unsettled >= OPTIONS.settled_s
        ):
            return replace(self, state=state, unsettled=None)
        return self if self.unsettled is not None else replace(self, unsettled=at)

    def _pick_up(self, carrier: Carrier, after: int, every: int = 1) -> PayloadTracker:
        """Return the tracker with the payload that the last `after` cells show; one of `every` cells was compared."""
        rows, before = Rows.concatenate(self.recent[-after:]), no_rows(self.n)
        # rows before must be free of any payload, but the payload may have been picked up within the last cell
        if self.held is None and (free := self.recent[: -after - every]):
            before = Rows.concatenate(free[-every * WINDOW.before :])
        held = TrackedPayload.of_rows(carrier, rows, before)
        estimate = held.estimate
        vague = 1 / VERDICT.positive if estimate.gain < VERDICT.at_once_nats else np.inf
        if after < VERDICT.lasting_cells or self.held is not None:
            vague = VERDICT.precise if estimate.gain - estimate.contact >= VERDICT.better_nats else 0.0
        strange = np.abs((estimate.eta - ANY_PAYLOAD.centre) / ETA_STD).max() > OPTIONS.max_stds
        if strange or np.sqrt(estimate.covariance[0, 0]) > vague * estimate.doubt:
            return self._with_state("contact")
        watch = replace(
            self, state="payload", unsettled=None, since=held.since, held=held, recent=self.recent[-after:], off=0
        )
        return watch._relinearise(carrier)

    def _judge_loaded(
        self, carrier: Carrier, parts: Sequence[Rows], window: CellWindow, gains: Gains
    ) -> PayloadTracker:
        """Judge the cells of an arm with a payload."""
        assert self.held is not None
        best = {kind: max(each[kind] for each in gains.values()) for kind in PRIOR}
        if max(best.values()) > VERDICT.likely_nats:
            down, after = self._gain_unloaded(carrier, window, gains)
            # an arm without a payload has no free parameter, so it needs less evidence than ten free numbers
            share = VERDICT.lasting_share if after >= VERDICT.lasting_cells else VERDICT.alike_share
            if down >= VERDICT.sure_nats and down >= share * max(gains[after].values()):
                since = float(self.recent[-after].time[0])
                fresh = PayloadTracker(self.n, "none", {"none": 1.0}, since, None, self.waiting, self.recent[-after:])
                return fresh._relinearise(carrier)
            if (changed := find_pickup(window, gains, self.held.estimate.load.payload)) is not None:
                return self._pick_up(carrier, changed)
        if max(best.values()) <= VERDICT.sure_nats:
            return replace(self, off=0)._estimate_from(carrier, parts)
        state = classify_state(gains)
        # friction seldom changes, and the payload's estimate is often inexact
        if state != "contact" and (corrected := self._correct(carrier, parts)) is not None:
            return corrected
        off = self.off + len(parts)
        if off >= OPTIONS.max_off:  # no contact lasts so long: the estimate is wrong, or the payload another one
            again = self._pick_up(carrier, len(self.recent))
            if again.held is not self.held:
                return again
        return replace(self, off=off)._with_state("payload" if state == "none" else state)

    def _correct(self, carrier: Carrier, parts: Sequence[Rows]) -> PayloadTracker | None:
        """Return the tracker with the payload estimated at once from more rows; None if it does not explain them."""
        assert self.held is not None
        held = self.held.add_rows(carrier, Rows.concatenate(parts), at_once=True)
        watch = replace(self, held=held, off=0)._relinearise(carrier)
        assert watch.around is not None
        gains = CellWindow.of(watch.around, watch.cells[-WINDOW.cells :]).gains()
        if max(max(each.values()) for each in gains.values()) > VERDICT.sure_nats:
            return None
        return replace(watch, probabilities=probabilities(gains))._with_state("payload")

    def _gain_unloaded(self, carrier: Carrier, window: CellWindow, gains: Gains) -> tuple[float, int]:
        """Return the nats by which the arm without payload explains the last cells better, and their number."""
        assert self.held is not None
        assert self.around is not None
        load = self.held.estimate.load
        mean = load.mean.copy()
        mean[-PARAMETERS:] = 0.0
        bare = LinearisedCarrier(carrier, replace(load, mean=mean, others=()))  # the others contain the payload, too
        parts, size = self.recent[-WINDOW.after[-1] :], len(window.cells[-1].features)
        seen = [replace(each, features=_unloaded(each.features, size)) for each in cells_of(bare, parts)]
        first, count = len(window.cells), len(window.cells) + len(seen)
        choices = [[*range(first - after), *range(count - after, count)] for after in gains]
        loads = CellWindow.among(self.around, [*window.cells, *seen], choices)
        gained = {after: each.density - window.density for after, each in zip(gains, loads, strict=True)}
        after = max(gained, key=lambda each: gained[each])
        return gained[after], after

    def refinement(self) -> Generator[None, None, TrackedPayload] | None:
        """Return a generator that refines the payload step by step; see `TrackedPayload.refinement`."""
        return None if self.held is None or self.around is None else self.held.refinement(self.around.carrier)

    def refined(self, refined: TrackedPayload) -> PayloadTracker:
        """Return the tracker with a payload that was refined meanwhile; unchanged if the payload is another one now."""
        assert self.around is not None
        if self.held is None or self.held.since != refined.since or self.held.declared != refined.declared:
            return self
        return replace(self, held=self.held.with_refined(refined))._relinearise(self.around.carrier)

    def has_same_payload(self, other: PayloadTracker) -> bool:
        """Whether it reports the same state and payload as another tracker."""
        mine, its = self.held, other.held
        same = mine is its or (mine is not None and its is not None and mine.estimate is its.estimate)
        return same and (self.state, self.since) == (other.state, other.since)

    def outline(self) -> PayloadTracker:
        """Return the tracker without its rows."""
        held = None if self.held is None else self.held.outline()
        return PayloadTracker(self.n, self.state, self.probabilities, self.since, held)

    def to_json(self) -> dict[str, Any]:
        """Return what a batch's report contains of it; `from_json` restores the payload."""
        return {
            "state": self.state,
            "since": self.since,
            "probabilities": dict(self.probabilities or {"none": 1.0}),
            "held": None if self.held is None else self.held.to_json(),
        }

    @staticmethod
    def from_other_version(values: Mapping[str, Any], n: int, carrier: Carrier) -> PayloadTracker:
        """Return the tracker that another version, with another frame of the last link, wrote with `to_json`."""
        since, held = values["since"], values["held"]
        if held is None:
            return PayloadTracker(n, since=since)
        return PayloadTracker(
            n, "payload", {"payload": 1.0}, since, TrackedPayload.from_other_version(held, float(since), carrier)
        )

    @staticmethod
    def from_json(values: Mapping[str, Any], n: int, carrier: Carrier, rows: Rows | None = None) -> PayloadTracker:
        """Read what `to_json` returned, for n joints. rows: with a payload, in order of event time."""
        since, held = values["since"], values["held"]
        carried = None if held is None else TrackedPayload.from_json(held, float(since), carrier, rows)
        return PayloadTracker(n, values["state"], values["probabilities"], since, carried)


def _unloaded(features: Array, size: int) -> Array:
    """Return the features of all unknowns, (size, n), of an arm without a payload."""
    out = np.zeros((size, features.shape[1]))
    out[: len(features) - PARAMETERS] = features[:-PARAMETERS]
    return out

"""One stream's payload, followed row by row: noticed, estimated, put down, declared."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lipcore.data.samples import Array
from lipcore.model.body import Body
from lipcore.model.payload import Carrier, Linearised, Load
from lipcore.online.batch import Rows
from lipcore.online.payload.bodies import ANY, WIDTH
from lipcore.online.payload.held import Held, evenly, no_rows
from lipcore.online.payload.hypotheses import WINDOW, Cell, Window, cells_of, parted
from lipcore.online.payload.verdict import PRIOR, VERDICT, Gains, probabilities, state_of, taken
from lipcore.robots.urdf import PARAMETERS
from lipcore.vocabulary import PayloadState


@dataclass(frozen=True)
class WatchOptions:
    """Cells that are judged, and how long states last."""

    sparse: tuple[int, ...] = (2, 4)
    """Of how many cells one is compared, where something lasts that a contact explains."""
    together: int = 3
    together_in_bulk: int = 6
    """Cells of one batch that are judged together, and of one that brings more than the second: an instant within the
    last cells is seen all the same."""
    cell_rows: int = 5
    """Max rows of a cell, evenly spread: a robot moves little within one, however often it is measured."""
    max_stds: float = 2.5
    """Standard deviations of what is known of any payload beyond which a body is none: heavier than 20 kg, or with its
    centre of mass further than 0.37 m from the last link's frame. A push looks like such a one."""
    max_off: int = 12
    """Successive cells that a payload does not explain, 0.6 s, after which it is estimated anew from them."""
    gap_s: float = 0.5
    """A longer time between two rows: what came before is not compared with what comes after."""
    settled_s: float = 1.0
    """A contact, or other friction, is named at once, and something else once rows have shown that for so long."""
    back_s: float = 60.0
    """Rows that are older than the latest by more are those of a clock that was set back: they begin anew."""


OPTIONS = WatchOptions()


@dataclass(frozen=True, eq=False)
class Watch:
    """What is known of one stream's payload; immutable. n: joints.

    state: what the last cells show; probabilities: of each hypothesis; since: event time, s, of the last change of
    whether something is held; waiting: rows that are no cell yet; recent: rows of the last cells, and these as they
    were seen with `around`; off: how many of them, one after the other, a payload does not explain; unsettled: event
    time, s, since when they show another state, None where they do not.
    """

    n: int
    state: PayloadState = "none"
    probabilities: Mapping[str, float] | None = None
    since: float | None = None
    held: Held | None = None
    waiting: Rows | None = None
    recent: tuple[Rows, ...] = ()
    cells: tuple[Cell, ...] = ()
    around: Linearised | None = None
    off: int = 0
    unsettled: float | None = None

    def step(self, carrier: Carrier, rows: Rows) -> Watch:
        """Follow rows, in order of event time; those from before the latest are passed over."""
        watch = self._seen_by(carrier)
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
            watch = watch._run(carrier, part)
        return watch

    def declare(self, carrier: Carrier, body: Body, at: float) -> Watch:
        """The same where a payload is known to be carried from event time `at`, s, on."""
        return Watch(self.n, "payload", {"payload": 1.0}, at, Held.of_declaration(carrier, body, at))

    def put_down(self, at: float) -> Watch:
        """The same where it is known that nothing is carried from event time `at`, s, on."""
        return Watch(self.n, since=at)

    @property
    def load(self) -> Load | None:
        """What is carried; None for nothing."""
        return None if self.held is None else self.held.estimate.load

    @property
    def _last(self) -> float | None:
        latest = self.waiting if self.waiting is not None else self.recent[-1] if self.recent else None
        return None if latest is None else float(latest.time[-1])

    def _seen_by(self, carrier: Carrier) -> Watch:
        """The same as another revision of the model sees it."""
        if self.around is None:
            return self._around(carrier)
        if self.around.carrier.knows_as(carrier):
            return self
        return replace(self, held=None if self.held is None else self.held.seen_by(carrier))._around(carrier)

    def _around(self, carrier: Carrier) -> Watch:
        """The same with its cells as they look with the payload as it is known by now."""
        load = carrier.known(np.zeros(PARAMETERS)) if self.load is None else self.load
        around = Linearised(carrier, load)
        return replace(self, around=around, cells=cells_of(around, self.recent) if self.recent else ())

    def _run(self, carrier: Carrier, rows: Rows) -> Watch:
        """Follow rows without a gap."""
        if self.waiting is not None:
            rows = Rows.concatenate([self.waiting, rows])
        # half a step before the end, as times waver
        step = float(np.median(np.diff(rows.time))) if len(rows) > 1 else 0.0
        ends, first = [], 0
        while first < len(rows):
            until = rows.time[first] + WINDOW.cell_s - 0.5 * step
            last = max(int(np.searchsorted(rows.time, until, side="left")), first + 1)
            if last == len(rows) and rows.time[-1] + step < until:
                break
            ends.append((first, last))
            first = last
        parts = [rows.take(evenly(*each, OPTIONS.cell_rows)) for each in ends]
        watch = replace(self, waiting=rows.take(slice(first, None)) if first < len(rows) else None)
        together = OPTIONS.together if len(parts) <= OPTIONS.together_in_bulk else OPTIONS.together_in_bulk
        for at in range(0, len(parts), together):
            watch = watch._take(carrier, parts[at : at + together])
        return watch

    def _take(self, carrier: Carrier, parts: Sequence[Rows]) -> Watch:
        """Take in cells, and judge the last ones."""
        assert self.around is not None
        parts, new = parted(self.around, parts)
        kept = WINDOW.cells * OPTIONS.sparse[-1] if self.held is None else WINDOW.cells
        cells = (*self.cells, *new)[-kept:]
        watch = replace(self, recent=(*self.recent, *parts)[-kept:], cells=cells)
        if len(cells) <= WINDOW.min_before:
            return watch if watch.held is None else watch._learn(carrier, parts)
        window = Window.of(self.around, cells[-WINDOW.cells :])
        # an arm that carries nothing as far as is known may have carried something from before the first cell on
        gains = window.gains((*WINDOW.after, WINDOW.cells) if self.held is None else WINDOW.after)
        watch = replace(watch, probabilities=probabilities(gains))
        return watch._free(carrier, window, gains) if self.held is None else watch._carry(carrier, parts, window, gains)

    def _learn(self, carrier: Carrier, parts: Sequence[Rows]) -> Watch:
        """Let rows teach the payload."""
        assert self.held is not None
        held = self.held.more(carrier, Rows.concatenate(parts))
        watch = replace(self, held=held)._named("payload")
        return watch if held.estimate is self.held.estimate else watch._around(carrier)

    def _free(self, carrier: Carrier, window: Window, gains: Gains) -> Watch:
        """Judge cells of an arm that carries nothing as far as is known."""
        if (after := taken(window, gains)) is not None:
            return self._take_up(carrier, after)
        state = state_of(gains)
        if state == "contact":  # it may be a payload that is heavier than the arm is known to: that lasts
            assert self.around is not None
            for every in OPTIONS.sparse:
                cells = self.cells[(len(self.cells) - 1) % every :: every][-WINDOW.cells :]
                if len(cells) < VERDICT.lasting_cells + WINDOW.min_before:
                    break
                window = Window.of(self.around, cells)
                if (after := taken(window, window.gains(), every=every)) is not None:
                    return self._take_up(carrier, every * after, every)
        return self._named(state)

    def _named(self, state: PayloadState) -> Watch:
        """The same where the last cells show a state."""
        if state == self.state:
            return replace(self, unsettled=None)
        at = float(self.recent[-1].time[-1])
        if self.state in ("none", "payload") or (
            self.unsettled is not None and at - self.unsettled >= OPTIONS.settled_s
        ):
            return replace(self, state=state, unsettled=None)
        return self if self.unsettled is not None else replace(self, unsettled=at)

    def _take_up(self, carrier: Carrier, after: int, every: int = 1) -> Watch:
        """Carry what the last cells show, so many. every: of how many cells one was looked at."""
        rows, before = Rows.concatenate(self.recent[-after:]), no_rows(self.n)
        if self.held is None and len(self.recent) > after:  # rows with another payload tell another beginning
            before = Rows.concatenate(self.recent[:-after][-every * WINDOW.before :])
        held = Held.of_rows(carrier, rows, before)
        estimate = held.estimate
        vague = 1 / VERDICT.positive if estimate.gain < VERDICT.at_once_nats else np.inf
        if after < VERDICT.lasting_cells or self.held is not None:
            vague = VERDICT.precise if estimate.gain - estimate.contact >= VERDICT.better_nats else 0.0
        strange = np.abs((estimate.eta - ANY.centre) / WIDTH).max() > OPTIONS.max_stds
        if strange or np.sqrt(estimate.covariance[0, 0]) > vague * estimate.doubt:
            return self._named("contact")
        watch = replace(
            self, state="payload", unsettled=None, since=held.since, held=held, recent=self.recent[-after:], off=0
        )
        return watch._around(carrier)

    def _carry(self, carrier: Carrier, parts: Sequence[Rows], window: Window, gains: Gains) -> Watch:
        """Judge cells of an arm that carries a payload."""
        assert self.held is not None
        best = {kind: max(each[kind] for each in gains.values()) for kind in PRIOR}
        if max(best.values()) > VERDICT.likely_nats:
            down, after = self._without(carrier, window, gains)
            # nothing is free about an arm without a payload: what explains as much with ten numbers explains less
            share = VERDICT.lasting_share if after >= VERDICT.lasting_cells else VERDICT.alike_share
            if down >= VERDICT.sure_nats and down >= share * max(gains[after].values()):
                since = float(self.recent[-after].time[0])
                fresh = Watch(self.n, "none", {"none": 1.0}, since, None, self.waiting, self.recent[-after:])
                return fresh._around(carrier)
            if (changed := taken(window, gains, self.held.estimate.load.payload)) is not None:
                return self._take_up(carrier, changed)
        if max(best.values()) <= VERDICT.sure_nats:
            return replace(self, off=0)._learn(carrier, parts)
        off = self.off + len(parts)
        if off >= OPTIONS.max_off:  # no contact lasts so long: it was estimated wrongly, or is another one
            again = self._take_up(carrier, len(self.recent))
            if again.held is not self.held:
                return again
        state = state_of(gains)
        return replace(self, off=off)._named("payload" if state == "none" else state)

    def _without(self, carrier: Carrier, window: Window, gains: Gains) -> tuple[float, int]:
        """Nats by which the arm without its payload explains the last cells better, and how many of them."""
        assert self.held is not None
        assert self.around is not None
        load = self.held.estimate.load
        mean = load.mean.copy()
        mean[-PARAMETERS:] = 0.0
        bare = Linearised(carrier, replace(load, mean=mean, others=()))  # which carry it, too
        parts, size = self.recent[-WINDOW.after[-1] :], len(window.cells[-1].features)
        seen = [replace(each, features=_unloaded(each.features, size)) for each in cells_of(bare, parts)]
        first, count = len(window.cells), len(window.cells) + len(seen)
        choices = [[*range(first - after), *range(count - after, count)] for after in gains]
        loads = Window.among(self.around, [*window.cells, *seen], choices)
        gained = {after: each.density - window.density for after, each in zip(gains, loads, strict=True)}
        after = max(gained, key=lambda each: gained[each])
        return gained[after], after

    def refinement(self) -> Generator[None, None, Held] | None:
        """What is carried, refined step by step; see `Held.refinement`."""
        return None if self.held is None or self.around is None else self.held.refinement(self.around.carrier)

    def refined(self, refined: Held) -> Watch:
        """The same with what was refined while rows came; as it is where something else is carried by now."""
        assert self.around is not None
        if self.held is None or self.held.since != refined.since or self.held.declared != refined.declared:
            return self
        return replace(self, held=self.held.with_refined(refined))._around(self.around.carrier)

    def says(self, other: Watch) -> bool:
        """Whether it says the same of what is carried as another one."""
        mine, its = self.held, other.held
        same = mine is its or (mine is not None and its is not None and mine.estimate is its.estimate)
        return same and (self.state, self.since) == (other.state, other.since)

    def outline(self) -> Watch:
        """What is carried, without the rows that say so."""
        held = None if self.held is None else self.held.outline()
        return Watch(self.n, self.state, self.probabilities, self.since, held)

    def to_json(self) -> dict[str, Any]:
        """What a batch's report says of it; `from_json` gives back what is carried."""
        return {
            "state": self.state,
            "since": self.since,
            "probabilities": dict(self.probabilities or {"none": 1.0}),
            "held": None if self.held is None else self.held.to_json(),
        }

    @staticmethod
    def of_another(values: Mapping[str, Any], n: int, carrier: Carrier) -> Watch:
        """What another version has written, by `to_json`, as one sees it whose frame of the last link is another."""
        since, held = values["since"], values["held"]
        if held is None:
            return Watch(n, since=since)
        return Watch(n, "payload", {"payload": 1.0}, since, Held.of_another(held, float(since), carrier))

    @staticmethod
    def from_json(values: Mapping[str, Any], n: int, carrier: Carrier, rows: Rows | None = None) -> Watch:
        """What `to_json` wrote, for n joints. rows: that a payload was seen on, in order of event time."""
        since, held = values["since"], values["held"]
        carried = None if held is None else Held.from_json(held, float(since), carrier, rows)
        return Watch(n, values["state"], values["probabilities"], since, carried)


def _unloaded(features: Array, size: int) -> Array:
    """Features of all that is unknown, (size, n), of an arm that carries nothing."""
    out = np.zeros((size, features.shape[1]))
    out[: len(features) - PARAMETERS] = features[:-PARAMETERS]
    return out

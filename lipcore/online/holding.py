"""One stream's payload, followed row by row: noticed, estimated, put down, declared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.model.payload import Body, Carrier, Linearised, Load
from lipcore.online.batch import Rows
from lipcore.online.bodies import ANY, Known, eta_of
from lipcore.online.hypotheses import AFTER, BEFORE, CELL_S, LEAST_BEFORE, Cell, Kind, Window, cells_of
from lipcore.online.payload import Estimate, estimate, known
from lipcore.robots.urdf import PARAMETERS
from lipcore.vocabulary import PayloadState

SURE, BETTER = 20.0, 5.0
"""Nats by which a payload explains the last cells better than nothing, and than a contact, to be taken for one at once.
In 60 s each of slow and of fast motion of the dirty Panda of seed 50 there were up to 28 and at most 2 at a time."""
CERTAIN, ALIKE = 60.0, 0.99
"""What is so certain is taken for a payload where that explains so large a share of what a contact does: the torques of
a contact are any, and those of a payload as good as the arm's geometry."""
LASTING, NEARLY = 6, 0.8
"""What lasts for so many cells, 0.3 s, is no knock any more, and needs a smaller share; twice as long, its square."""
CELLS, SPARSE = BEFORE + AFTER[-1], (2, 4)
"""Cells that are looked at together; and of how many there is one, where something lasts that a contact explains."""
AT_ONCE, PRECISE = 3000.0, 0.1
"""Nats from which on a payload is taken for one before it lasts, and the deviation of the logarithm of its mass then: a
push that looks like a body to within some tenths of its torque is no rare chance, to within hundredths it is."""
LIKELY = 10.0
"""Nats from which on a contact is named. Cells that are as far off as SURE teach nothing of the payload."""
POSITIVE, ANOTHER = 1.5, 200.0
"""Standard deviations above zero that the mass of a payload lies that is taken up; nats by which another payload has to
explain more than the one that is carried, of which rows go on telling more. Both as SURE."""
PRIOR: Mapping[Kind, float] = {"payload": -12.0, "contact": -7.0, "friction": -16.0}
"""Logarithm of how probable each is to begin within a cell: a contact once a minute, a payload once in two hours, other
friction all at once in days."""
MOST_ROWS, BEFORE_ROWS, GROWTH, ANEW = 100, 10, 1.25, 2.0
"""Rows that a payload is estimated from, evenly spread over the time since; rows before it; by how many times they have
to grow until it is estimated again, and until it is from nothing."""
TOGETHER, IN_BULK = 3, 6
"""Cells of one batch that are judged together, and of one that brings many: an instant within the last AFTER is seen
all the same."""
CELL_ROWS = 5
"""Rows of a cell that are looked at, evenly spread: a robot moves little within one, however often it is measured."""
STRANGE = 2.5
"""Standard deviations of what is known of any payload beyond which a body is none: heavier than 20 kg, or with its
centre of mass further than 0.37 m from the last link's frame. A push looks like such a one."""
GAP_S = 0.5
"""A longer time between two rows: what came before is not compared with what comes after."""
DECLARED, WRONG = np.array([0.02, *[0.005] * 3, *[0.3] * 3, *[0.005] * 3]), 4.0
"""Standard deviations of η of a payload that was declared: of log mass, m, of log m, m; and how many of them it lies
off where rows show that something else is carried."""
Gains = Mapping[int, Mapping[Kind, float]]
KINDS: tuple[Kind, ...] = ("payload", "contact", "friction")


@dataclass(frozen=True, eq=False)
class Held:
    """A payload that is carried. since: event time, s, from which on; declared: whether it was said and not only seen;
    rows: that it is estimated from, before: that came before it; every: of how many rows one is kept; count: rows that
    it was seen on; due: their number at which it is estimated again; prior: what was known of it;
    begun: their number when it was last estimated from nothing."""

    since: float
    declared: bool
    rows: Rows
    before: Rows
    every: int
    count: int
    due: float
    prior: Known
    estimate: Estimate
    begun: int = 0

    def more(self, carrier: Carrier, rows: Rows) -> Held:
        """The same with more rows."""
        first = -self.count % self.every
        kept = Rows.concatenate([self.rows, rows.take(slice(first, None, self.every))])
        every, count = self.every, self.count + len(rows)
        if len(kept) > MOST_ROWS:
            kept, every = kept.take(slice(0, None, 2)), 2 * every
        held = replace(self, rows=kept, every=every, count=count)
        if count < self.due:
            return held
        anew = count >= ANEW * self.begun
        found = estimate(carrier, kept, self.before, self.prior, self.estimate, anew)
        if self.declared and np.abs((found.eta - self.prior.centre) / DECLARED).max() > WRONG:
            held, found = replace(held, declared=False, prior=ANY), estimate(carrier, kept, self.before)
        return replace(held, due=GROWTH * count, estimate=found, begun=count if anew else self.begun)


@dataclass(frozen=True, eq=False)
class Watch:
    """What is known of one stream's payload; immutable. n: joints.

    state: what the last cells show; probabilities: of each hypothesis; since: event time, s, of the last change of
    whether something is held; waiting: rows that are no cell yet; recent: rows of the last cells, and these as they
    were seen with `around`.
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

    def step(self, carrier: Carrier, rows: Rows) -> Watch:
        """Follow rows, in order of event time; those from before the latest are passed over."""
        watch = self._seen_by(carrier)
        assert watch.around is not None
        carrier = watch.around.carrier
        if watch._last is not None:
            rows = rows.take(rows.time > watch._last)
        if not len(rows):
            return watch
        for places in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(rows.time) > GAP_S) + 1):
            part = rows.take(places)
            last = watch._last
            if last is not None and part.time[0] - last > GAP_S:
                watch = replace(watch, waiting=None, recent=(), cells=())
            watch = watch._run(carrier, part)
        return watch

    def declare(self, carrier: Carrier, body: Body, at: float) -> Watch:
        """The same where a payload is known to be carried from event time `at`, s, on."""
        eta = eta_of(body)
        prior = Known(eta, np.diag(DECLARED**-2.0))
        nothing = _none(self.n)
        held = Held(at, True, nothing, nothing, 1, 0, 1.0, prior, known(carrier, prior))
        return Watch(self.n, "payload", {"payload": 1.0}, at, held)

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
        if self.around is not None and self.around.carrier.knows_as(carrier):
            return self
        held = self.held
        if held is not None:
            again = estimate(carrier, held.rows, held.before, held.prior, held.estimate) if len(held.rows) else None
            held = replace(held, estimate=again or known(carrier, _as_prior(held.estimate)))
        return replace(self, held=held)._around(carrier)

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
            until = rows.time[first] + CELL_S - 0.5 * step
            last = max(int(np.searchsorted(rows.time, until, side="left")), first + 1)
            if last == len(rows) and rows.time[-1] + step < until:
                break
            ends.append((first, last))
            first = last
        parts = [rows.take(_evenly(*each)) for each in ends]
        watch = replace(self, waiting=rows.take(slice(first, None)) if first < len(rows) else None)
        together = TOGETHER if len(parts) <= IN_BULK else IN_BULK
        for at in range(0, len(parts), together):
            watch = watch._take(carrier, parts[at : at + together])
        return watch

    def _take(self, carrier: Carrier, parts: Sequence[Rows]) -> Watch:
        """Take in cells, and judge the last ones."""
        assert self.around is not None
        kept = CELLS * SPARSE[-1] if self.held is None else CELLS
        cells = (*self.cells, *cells_of(self.around, parts))[-kept:]
        watch = replace(self, recent=(*self.recent, *parts)[-kept:], cells=cells)
        if len(cells) <= LEAST_BEFORE:
            return watch if watch.held is None else watch._learn(carrier, parts)
        window = Window.of(self.around, cells[-CELLS:])
        # an arm that carries nothing as far as is known may have carried something from before the first cell on
        gains = window.gains((*AFTER, CELLS) if self.held is None else AFTER)
        watch = replace(watch, probabilities=_probabilities(gains))
        return watch._free(carrier, window, gains) if self.held is None else watch._carry(carrier, parts, window, gains)

    def _learn(self, carrier: Carrier, parts: Sequence[Rows]) -> Watch:
        """Let rows teach the payload."""
        assert self.held is not None
        held = self.held.more(carrier, Rows.concatenate(parts))
        watch = replace(self, state="payload", held=held)
        return watch if held.estimate is self.held.estimate else watch._around(carrier)

    def _free(self, carrier: Carrier, window: Window, gains: Gains) -> Watch:
        """Judge cells of an arm that carries nothing as far as is known."""
        if (after := _taken(window, gains)) is not None:
            return self._take_up(carrier, after)
        state = _state(gains)
        if state == "contact":  # it may be a payload that is heavier than the arm is known to: that lasts
            assert self.around is not None
            for every in SPARSE:
                cells = self.cells[(len(self.cells) - 1) % every :: every][-CELLS:]
                if len(cells) < LASTING + LEAST_BEFORE:
                    break
                window = Window.of(self.around, cells)
                if (after := _taken(window, window.gains(), every=every)) is not None:
                    return self._take_up(carrier, every * after, every)
        return replace(self, state=state)

    def _take_up(self, carrier: Carrier, after: int, every: int = 1) -> Watch:
        """Carry what the last cells show, so many. every: of how many cells one was looked at."""
        rows, before = Rows.concatenate(self.recent[-after:]), _none(self.n)
        if self.held is None and len(self.recent) > after:  # rows with another payload tell another beginning
            before = Rows.concatenate(self.recent[:-after][-every * BEFORE :])
            before = before.take(slice(None, None, -(-len(before) // BEFORE_ROWS)))
        found = estimate(carrier, rows, before)
        strange = np.abs((found.eta - ANY.centre) / np.sqrt(1 / np.diagonal(ANY.precision))).max() > STRANGE
        vague = 1 / POSITIVE if found.gain < AT_ONCE else np.inf
        if after < LASTING:
            vague = PRECISE if found.gain - found.contact >= BETTER else 0.0
        if strange or np.sqrt(found.covariance[0, 0]) > vague:
            return replace(self, state="contact")
        since = float(rows.time[0])
        held = Held(since, False, rows, before, 1, len(rows), GROWTH * len(rows), ANY, found, len(rows))
        watch = replace(self, state="payload", since=since, held=held, recent=self.recent[-after:])
        return watch._around(carrier)

    def _carry(self, carrier: Carrier, parts: Sequence[Rows], window: Window, gains: Gains) -> Watch:
        """Judge cells of an arm that carries a payload."""
        best = {kind: max(each[kind] for each in gains.values()) for kind in KINDS}
        if max(best.values()) > LIKELY:
            down, after = self._without(carrier, window, gains)
            # nothing is free about an arm without a payload: what explains as much with ten numbers explains less
            share = NEARLY if after >= LASTING else ALIKE
            if down >= SURE and down >= share * max(gains[after].values()):
                since = float(self.recent[-after].time[0])
                fresh = Watch(self.n, "none", {"none": 1.0}, since, None, self.waiting, self.recent[-after:])
                return fresh._around(carrier)
            if (changed := _taken(window, gains, self.held)) is not None:
                return self._take_up(carrier, changed)
        if max(best.values()) > SURE:
            state = _state(gains)
            return replace(self, state="payload" if state == "none" else state)
        return self._learn(carrier, parts)

    def _without(self, carrier: Carrier, window: Window, gains: Gains) -> tuple[float, int]:
        """Nats by which the arm without its payload explains the last cells better, and how many of them."""
        assert self.held is not None
        assert self.around is not None
        load = self.held.estimate.load
        mean = load.mean.copy()
        mean[-PARAMETERS:] = 0.0
        bare = Linearised(carrier, replace(load, mean=mean))
        parts = self.recent[-AFTER[-1] :]
        seen = [replace(each, features=_unloaded(each.features)) for each in cells_of(bare, parts)]
        first, count = len(window.cells), len(window.cells) + len(seen)
        choices = [[*range(first - after), *range(count - after, count)] for after in gains]
        loads = Window.among(self.around, [*window.cells, *seen], choices)
        found = {after: each.density - window.density for after, each in zip(gains, loads, strict=True)}
        after = max(found, key=lambda each: found[each])
        return found[after], after

    def to_json(self) -> dict[str, Any]:
        """What a batch's report says of it; `from_json` gives back what is carried."""
        out: dict[str, Any] = {
            "state": self.state,
            "since": self.since,
            "probabilities": dict(self.probabilities or {"none": 1.0}),
            "held": None,
        }
        if self.held is not None:
            found = self.held.estimate
            out["held"] = {
                "declared": self.held.declared,
                "rows": self.held.count,
                "eta": found.eta.tolist(),
                "covariance": found.covariance.tolist(),
            }
        return out

    @staticmethod
    def from_json(values: Mapping[str, Any], n: int, carrier: Carrier, rows: Rows | None = None) -> Watch:
        """What `to_json` wrote, for n joints. rows: that the payload was seen on, in order of event time. Without them
        it is known by itself and not with the arm: rows that follow tell."""
        watch = Watch(n, values["state"], values["probabilities"], values["since"])
        if (kept := values["held"]) is None:
            return watch
        nothing, count, since, declared = _none(n), int(kept["rows"]), float(values["since"]), kept["declared"]
        eta, covariance = np.array(kept["eta"]), np.array(kept["covariance"])
        if rows is not None:
            rows = rows.take(_evenly(0, len(rows), MOST_ROWS))
            every = max(1, round(count / len(rows)))
            found = replace(estimate(carrier, rows), eta=eta, covariance=covariance)
            held = Held(since, declared, rows, nothing, every, count, GROWTH * count, ANY, found, count)
        else:
            prior = Known(eta, np.linalg.inv(covariance))
            held = Held(since, declared, nothing, nothing, 1, count, count + 1.0, prior, known(carrier, prior))
        return replace(watch, held=held)


def _taken(window: Window, gains: Gains, held: Held | None = None, every: int = 1) -> int | None:
    """For how many cells something has been carried, or something else; None where that does not show. every: of how
    many cells the window has one."""
    after = max(gains, key=lambda each: gains[each]["payload"])
    contact = gains[after]["contact"]
    best = gains[after]["payload"]
    # at once, the rows decide with the arm's geometry as they have it; see `Watch._take_up`
    near = after >= LASTING or (held is None and best >= AT_ONCE)
    share = NEARLY**every if near and after < len(window.cells) else ALIKE
    sure, certain = (SURE, CERTAIN) if held is None else (ANOTHER, ANOTHER)

    def shows(payload: float) -> bool:
        return (payload >= sure and payload - contact >= BETTER) or (payload >= certain and payload >= share * contact)

    if not shows(best) or (after < LASTING and (best < AT_ONCE or every > 1)):
        return None
    if held is None:
        mass, std = window.mass(after)
        if mass < POSITIVE * std:  # something is gone that the arm was trained with, or that was not noticed
            return None
    carried = np.zeros(PARAMETERS) if held is None else held.estimate.load.payload
    real = window.of_body(after, carried)
    return after if shows(real) and min(best, real) - window.past_contact() >= BETTER else None


def _evenly(first: int, last: int, most: int = CELL_ROWS) -> NDArray[np.int64]:
    """Places from `first` to before `last`, so many at most, both ends among them."""
    return np.unique(np.linspace(first, last - 1, min(most, last - first)).round().astype(np.int64))


def _unloaded(features: Array) -> Array:
    """Features of (w, π) of an arm that carries nothing."""
    return np.concatenate([features[:-PARAMETERS], np.zeros_like(features[-PARAMETERS:])])


def _state(gains: Gains) -> PayloadState:
    best = {kind: max(each[kind] for each in gains.values()) for kind in KINDS}
    if max(best["contact"], best["friction"]) <= LIKELY:
        return "none"
    return "contact" if best["contact"] + PRIOR["contact"] >= best["friction"] + PRIOR["friction"] else "friction"


def _probabilities(gains: Gains) -> dict[str, float]:
    """Of nothing new, and of each hypothesis to hold for one of the numbers of cells."""
    logs: dict[str, float] = {"none": 0.0}
    for kind, prior in PRIOR.items():
        logs[kind] = prior + float(np.logaddexp.reduce([each[kind] for each in gains.values()]))
    values = np.array(list(logs.values()))
    share = np.exp(values - np.logaddexp.reduce(values))
    return dict(zip(logs, share.tolist(), strict=True))


def _as_prior(found: Estimate) -> Known:
    return Known(found.eta, np.asarray(np.linalg.inv(found.covariance), np.float64))


def _none(n: int) -> Rows:
    """No rows of n joints."""
    empty: Array = np.empty((0, n))
    return Rows(np.empty(0), empty, empty, empty, empty, np.empty(0, np.uint8))

"""A payload that is carried: estimated again as its rows grow, declared, and written down."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.model.body import Body
from lipcore.model.payload import Carrier
from lipcore.online.batch import Rows
from lipcore.online.payload.bodies import ANY, Known, eta_of, inverse
from lipcore.online.payload.estimate import Estimate, known
from lipcore.online.payload.payload import estimate, refine


@dataclass(frozen=True)
class HeldOptions:
    """Rows that a payload is estimated from, and when it is estimated again."""

    max_rows: int = 100
    """Max rows with the payload, evenly spread over the time since."""
    max_rows_before: int = 10
    growth: float = 1.45
    """A payload is estimated, or refined, again once its rows have grown by this factor."""
    growth_anew: float = 2.0
    """Draws begin anew once the rows have grown by this factor."""
    max_stds: float = 4.0
    """A declared payload is wrong if rows show it further off, in standard deviations."""


OPTIONS = HeldOptions()
DECLARED = np.array([0.02, *[0.005] * 3, *[0.3] * 3, *[0.005] * 3])
"""Standard deviations of η of a payload that was declared: of log mass, m, of log m, m."""
MOVED = np.array([0.02, *[0.1] * 3, *[0.3] * 3, *[0.02] * 3])
"""What η of a payload may differ by from one version's frame to another's: of log mass, m, of log m, m."""


@dataclass(frozen=True, eq=False)
class Held:
    """A payload that is carried.

    since: event time, s, from which on; declared: whether by its owner, and not only seen; rows: that it is estimated
    from, before: that came before it; every: of how many rows one is kept; count: rows that it was seen on; due: their
    number at which it is estimated again; prior: what was known of it; refined, begun: their number when it was refined
    last, and when draws began anew.
    """

    since: float
    declared: bool
    rows: Rows
    before: Rows
    every: int
    count: int
    due: float
    prior: Known
    estimate: Estimate
    refined: int = 0
    begun: int = 0

    @staticmethod
    def of_rows(carrier: Carrier, rows: Rows, before: Rows) -> Held:
        """What rows show, beside those before them."""
        before = before.take(slice(None, None, max(1, -(-len(before) // OPTIONS.max_rows_before))))
        first, count = estimate(carrier, rows, before), len(rows)
        return Held(float(rows.time[0]), False, rows, before, 1, count, OPTIONS.growth * count, ANY, first)

    @staticmethod
    def of_declaration(carrier: Carrier, body: Body, at: float) -> Held:
        """What is declared to be carried from event time `at`, s, on."""
        prior, nothing = Known(eta_of(body), np.diag(DECLARED**-2.0)), no_rows(carrier.model.n_joints)
        return Held(at, True, nothing, nothing, 1, 0, 1.0, prior, known(carrier, prior))

    def outline(self) -> Held:
        """The same without its rows and draws: what follows is added to what they have shown."""
        nothing, found = no_rows(self.rows.q.shape[1]), replace(self.estimate, draws=())
        prior = self.prior if self.declared else Known(found.eta, inverse(found.covariance))
        return replace(self, rows=nothing, before=nothing, every=1, due=self.count + 1.0, prior=prior, estimate=found)

    def seen_by(self, carrier: Carrier) -> Held:
        """The same as another revision of the model sees it."""
        if self.estimate.draws:
            return replace(self, refined=0)  # which is slower: until then it is as the revision before saw it
        if len(self.rows):
            return replace(self, estimate=estimate(carrier, self.rows, self.before, self.prior, self.estimate))
        prior = Known(self.estimate.eta, inverse(self.estimate.covariance))
        return replace(self, estimate=known(carrier, prior))

    def to_json(self) -> dict[str, Any]:
        """What a batch's report says of it."""
        return {
            "declared": self.declared,
            "rows": self.count,
            "eta": self.estimate.eta.tolist(),
            "covariance": self.estimate.covariance.tolist(),
        }

    @staticmethod
    def of_another(values: Mapping[str, Any], since: float, carrier: Carrier) -> Held:
        """What another version has written, by `to_json`, whose last link has a frame of its own: a payload of this
        mass lies about there. Rows tell where."""
        covariance = np.array(values["covariance"]) + np.diag(MOVED**2)
        prior, nothing = Known(np.array(values["eta"]), inverse(covariance)), no_rows(carrier.model.n_joints)
        return Held(since, False, nothing, nothing, 1, 0, 1.0, prior, known(carrier, prior))

    @staticmethod
    def from_json(values: Mapping[str, Any], since: float, carrier: Carrier, rows: Rows | None) -> Held:
        """What `to_json` wrote. rows: that it was seen on, in order of event time. Without them it is known by itself
        and not with the arm: rows that follow tell."""
        count, nothing = int(values["rows"]), no_rows(carrier.model.n_joints)
        eta, covariance = np.array(values["eta"]), np.array(values["covariance"])
        if rows is None:
            prior = Known(eta, inverse(covariance))
            return Held(
                since, values["declared"], nothing, nothing, 1, count, count + 1.0, prior, known(carrier, prior)
            )
        rows = rows.take(evenly(0, len(rows), OPTIONS.max_rows))
        seen = replace(estimate(carrier, rows), eta=eta, covariance=covariance)
        every = max(1, round(count / len(rows)))
        return Held(since, values["declared"], rows, nothing, every, count, OPTIONS.growth * count, ANY, seen)

    def more(self, carrier: Carrier, rows: Rows) -> Held:
        """The same with more rows."""
        first = -self.count % self.every
        kept = Rows.concatenate([self.rows, rows.take(slice(first, None, self.every))])
        every, count = self.every, self.count + len(rows)
        if len(kept) > OPTIONS.max_rows:
            kept, every = kept.take(slice(0, None, 2)), 2 * every
        held = replace(self, rows=kept, every=every, count=count)
        if count < self.due or (self.estimate.draws and carrier.open_tip):  # its valleys are followed by refining alone
            return held
        moved = replace(estimate(carrier, kept, self.before, self.prior, self.estimate), draws=self.estimate.draws)
        if self.declared and np.abs((moved.eta - self.prior.centre) / DECLARED).max() > OPTIONS.max_stds:
            held, moved = replace(held, declared=False, prior=ANY), estimate(carrier, kept, self.before)
        return replace(held, due=OPTIONS.growth * count, estimate=moved)

    def refinement(self, carrier: Carrier) -> Generator[None, None, Held] | None:
        """The same with a refined estimate, step by step; None where that would tell nothing new."""
        if not carrier.bends or self.declared or not len(self.rows):
            return None
        # with more rows, what was as good as linear stays so for long
        if self.count >= (OPTIONS.growth if self.estimate.draws else OPTIONS.growth_anew) * self.refined:
            return self._refined(carrier, anew=False)
        if self.estimate.draws and self.count >= OPTIONS.growth_anew * self.begun:
            return self._refined(carrier, anew=True)
        return None

    def _refined(self, carrier: Carrier, anew: bool) -> Generator[None, None, Held]:
        found = yield from refine(carrier, self.rows, self.before, self.prior, self.estimate, anew)
        begun = self.count if anew else self.begun
        return replace(self, estimate=found, refined=self.count, begun=begun, due=OPTIONS.growth * self.count)

    def with_refined(self, refined: Held) -> Held:
        """The same, refined from fewer rows while these came."""
        if self.due > OPTIONS.growth * refined.due:  # it was estimated again, from many more rows
            newer = replace(self.estimate, draws=refined.estimate.draws)
            return replace(self, estimate=newer, refined=refined.refined, begun=refined.begun)
        return replace(self, estimate=refined.estimate, refined=refined.refined, begun=refined.begun, due=refined.due)


def evenly(first: int, last: int, most: int) -> NDArray[np.int64]:
    """Places from `first` to before `last`, so many at most, both ends among them."""
    return np.unique(np.linspace(first, last - 1, min(most, last - first)).round().astype(np.int64))


def no_rows(n: int) -> Rows:
    """No rows of n joints."""
    empty: Array = np.empty((0, n))
    return Rows(np.empty(0), empty, empty, empty, empty, np.empty(0, np.uint8))

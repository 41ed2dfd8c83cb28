"""Track one payload: estimate it again as its rows grow, accept a declaration, and serialise it."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lipcore.data.motion import spaced_rows
from lipcore.data.samples import Array
from lipcore.model.body import Body
from lipcore.model.payload import Carrier
from lipcore.online.batch import Rows
from lipcore.online.payload.bodies import ANY_PAYLOAD, PayloadPrior, eta_of, inverse
from lipcore.online.payload.estimate import Estimate, estimate_from_prior
from lipcore.online.payload.payload import estimate, refine


@dataclass(frozen=True)
class TrackedPayloadOptions:
    """Rows that a payload is estimated from, and when it is estimated again."""

    max_rows: int = 100
    """Max rows with the payload, evenly spread over the time since."""
    max_rows_before: int = 10
    max_misfit: float = 3.0
    """Mean square of the whitened errors beyond which rows before the payload may contradict it."""
    growth: float = 1.45
    """The payload is estimated, or refined, again once its rows have grown by this factor."""
    growth_anew: float = 2.0
    """Draws start again once the rows have grown by this factor."""
    max_stds: float = 4.0
    """A declared payload is wrong if rows show it further off, in standard deviations."""


OPTIONS = TrackedPayloadOptions()
DECLARED_STD = np.array([0.02, *[0.005] * 3, *[0.3] * 3, *[0.005] * 3])
"""Standard deviations of η of a declared payload: of log mass, m, of log m, m."""
FRAME_STD = np.array([0.02, *[0.1] * 3, *[0.3] * 3, *[0.02] * 3])
"""Standard deviations of the change of η between the frames of two versions: of log mass, m, of log m, m."""


@dataclass(frozen=True, eq=False)
class TrackedPayload:
    """A payload that an arm carries."""

    since: float
    """Event time since when, s."""
    declared: bool
    """Whether a user declared it; otherwise it was detected."""
    rows: Rows
    """Rows from which it is estimated."""
    before: Rows
    """Rows before the payload."""
    every: int
    """One in `every` rows is stored."""
    count: int
    """Number of rows with the payload."""
    due: float
    """Value of `count` at which it is estimated again."""
    prior: PayloadPrior
    """Prior of the payload."""
    estimate: Estimate
    refined: int = 0
    """`count` at the last refinement."""
    begun: int = 0
    """`count` when draws last started again."""

    @staticmethod
    def of_rows(carrier: Carrier, rows: Rows, before: Rows) -> TrackedPayload:
        """Return the payload that rows show. before: rows without it."""
        before = before.take(slice(None, None, max(1, -(-len(before) // OPTIONS.max_rows_before))))
        first, count = estimate(carrier, rows, before), len(rows)
        if len(before) and first.misfit > OPTIONS.max_misfit:  # it may have been picked up earlier
            alone = estimate(carrier, rows)
            if alone.misfit < 0.5 * first.misfit:
                first, before = alone, no_rows(carrier.model.n_joints)
        return TrackedPayload(
            float(rows.time[0]), False, rows, before, 1, count, OPTIONS.growth * count, ANY_PAYLOAD, first
        )

    @staticmethod
    def of_declaration(carrier: Carrier, body: Body, at: float) -> TrackedPayload:
        """Return the payload declared from event time `at`, s."""
        prior, nothing = PayloadPrior(eta_of(body), np.diag(DECLARED_STD**-2.0)), no_rows(carrier.model.n_joints)
        return TrackedPayload(at, True, nothing, nothing, 1, 0, 1.0, prior, estimate_from_prior(carrier, prior))

    def outline(self) -> TrackedPayload:
        """Return the payload without its rows and draws; later rows add to its estimate."""
        nothing, found = no_rows(self.rows.q.shape[1]), replace(self.estimate, draws=())
        prior = self.prior if self.declared else PayloadPrior(found.eta, inverse(found.covariance))
        return replace(self, rows=nothing, before=nothing, every=1, due=self.count + 1.0, prior=prior, estimate=found)

    def adapt_to(self, carrier: Carrier) -> TrackedPayload:
        """Return the payload for another revision of the model."""
        if self.estimate.draws:
            return replace(self, refined=0)  # refining is slow: until then the old estimate remains
        if len(self.rows):
            return replace(self, estimate=estimate(carrier, self.rows, self.before, self.prior, self.estimate))
        prior = PayloadPrior(self.estimate.eta, inverse(self.estimate.covariance))
        return replace(self, estimate=estimate_from_prior(carrier, prior))

    def to_json(self) -> dict[str, Any]:
        """Return what a batch's report contains of it."""
        return {
            "declared": self.declared,
            "rows": self.count,
            "eta": self.estimate.eta.tolist(),
            "covariance": self.estimate.covariance.tolist(),
        }

    @staticmethod
    def from_other_version(values: Mapping[str, Any], since: float, carrier: Carrier) -> TrackedPayload:
        """Return the payload that another version wrote with `to_json`.

        The last link of each version has its own frame. The mass is the same, the place is similar. Rows determine it.
        """
        covariance = np.array(values["covariance"]) + np.diag(FRAME_STD**2)
        prior, nothing = PayloadPrior(np.array(values["eta"]), inverse(covariance)), no_rows(carrier.model.n_joints)
        return TrackedPayload(since, False, nothing, nothing, 1, 0, 1.0, prior, estimate_from_prior(carrier, prior))

    @staticmethod
    def from_json(values: Mapping[str, Any], since: float, carrier: Carrier, rows: Rows | None) -> TrackedPayload:
        """Read what `to_json` returned. rows: with the payload, in order of event time.

        Without rows its correlation with the arm is lost, and later rows determine it.
        """
        count, nothing = int(values["rows"]), no_rows(carrier.model.n_joints)
        eta, covariance = np.array(values["eta"]), np.array(values["covariance"])
        if rows is None:
            prior = PayloadPrior(eta, inverse(covariance))
            return TrackedPayload(
                since,
                values["declared"],
                nothing,
                nothing,
                1,
                count,
                count + 1.0,
                prior,
                estimate_from_prior(carrier, prior),
            )
        rows = rows.take(spaced_rows(len(rows), OPTIONS.max_rows))
        seen = replace(estimate(carrier, rows), eta=eta, covariance=covariance)
        every = max(1, round(count / len(rows)))
        return TrackedPayload(
            since, values["declared"], rows, nothing, every, count, OPTIONS.growth * count, ANY_PAYLOAD, seen
        )

    def add_rows(self, carrier: Carrier, rows: Rows, at_once: bool = False) -> TrackedPayload:
        """Return the payload after more rows. at_once: whether it is estimated again, though it is not due."""
        first = -self.count % self.every
        kept = Rows.concatenate([self.rows, rows.take(slice(first, None, self.every))])
        every, count = self.every, self.count + len(rows)
        if len(kept) > OPTIONS.max_rows:
            kept, every = kept.take(slice(0, None, 2)), 2 * every
        held = replace(self, rows=kept, every=every, count=count)
        # if the tip is unidentified, only refining follows its valleys
        due = count >= self.due and not (self.estimate.draws and carrier.is_tip_unidentified)
        if not (due or at_once):
            return held
        moved = replace(estimate(carrier, kept, self.before, self.prior, self.estimate), draws=self.estimate.draws)
        if self.declared and np.abs((moved.eta - self.prior.centre) / DECLARED_STD).max() > OPTIONS.max_stds:
            held, moved = replace(held, declared=False, prior=ANY_PAYLOAD), estimate(carrier, kept, self.before)
        return replace(held, due=OPTIONS.growth * count, estimate=moved)

    def refinement(self, carrier: Carrier) -> Generator[None, None, TrackedPayload] | None:
        """Return a generator that refines the payload's estimate step by step; None if that would change nothing."""
        if not carrier.is_nonlinear or self.declared or not len(self.rows):
            return None
        # a posterior that was nearly linear remains so with more rows
        if self.count >= (OPTIONS.growth if self.estimate.draws else OPTIONS.growth_anew) * self.refined:
            return self._refined(carrier, anew=False)
        if self.estimate.draws and self.count >= OPTIONS.growth_anew * self.begun:
            return self._refined(carrier, anew=True)
        return None

    def _refined(self, carrier: Carrier, anew: bool) -> Generator[None, None, TrackedPayload]:
        found = yield from refine(carrier, self.rows, self.before, self.prior, self.estimate, anew)
        begun = self.count if anew else self.begun
        return replace(self, estimate=found, refined=self.count, begun=begun, due=OPTIONS.growth * self.count)

    def with_refined(self, refined: TrackedPayload) -> TrackedPayload:
        """Return the payload with a refinement that was computed from fewer rows."""
        if self.due > OPTIONS.growth * refined.due:  # it was estimated again, from many more rows
            newer = replace(self.estimate, draws=refined.estimate.draws)
            return replace(self, estimate=newer, refined=refined.refined, begun=refined.begun)
        return replace(self, estimate=refined.estimate, refined=refined.refined, begun=refined.begun, due=refined.due)


def no_rows(n: int) -> Rows:
    """Return no rows of n joints."""
    empty: Array = np.empty((0, n))
    return Rows(np.empty(0), empty, empty, empty, empty, np.empty(0, np.uint8))

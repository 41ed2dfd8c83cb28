"""Two followers of one log in contest: what each predicts before it learns, brought together event by event."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import inf

from lipcore.data.samples import Array
from lipcore.online.batch import Rows
from service.foundation.settings import Settings
from service.learning.learner.follower import Follower
from service.learning.learner.messages import Contested
from service.learning.learner.restore import Arrival
from service.learning.refreshing.contest import Contest, Verdict, sample

PENDING = 2000
"""Events that one follower may be ahead of the other before the oldest is dropped uncompared."""
TELL_EVERY_S = 30.0
"""Seconds after which a verdict that nothing has followed from is told again."""


@dataclass(frozen=True)
class _Answer:
    """What a follower predicted of rows of an event: mean and std (N, n), noise std (n,); received: Unix time, s."""

    rows: Rows
    received: float
    predicted: tuple[Array, Array, Array]


class Duel:
    """Contest of the version that serves with a candidate; for one thread.

    It hears of each batch from both followers before they learn it, so that both predict it unseen, and compares the
    batches that both have told of: what one has learnt before the duel began is left out. Where the log is rewound, the
    contest begins anew.
    """

    def __init__(self, serving: Follower, candidate: Follower, settings: Settings) -> None:
        self.serving, self.candidate, self.settings = serving, candidate, settings
        self.verdict: Verdict | None = None
        self._begin(max(serving.number, candidate.number))
        for follower in (serving, candidate):
            follower.watchers.append(self._hear)

    def close(self) -> None:
        """Hear no more."""
        for follower in (self.serving, self.candidate):
            follower.watchers.remove(self._hear)

    def outcome(self) -> Contested | None:
        """The verdict as a message to the service, once there is one."""
        if self.verdict is None:
            return None
        return Contested(
            model=self.serving.model,
            serving=self.serving.version,
            candidate=self.candidate.version,
            verdict=self.verdict,
            evidence=self.contest.evidence(),
        )

    def _begin(self, after: int) -> None:
        """Compare what comes after an event."""
        self.contest = Contest.start(self.serving.base.n_joints)
        self._heard = dict.fromkeys((self.serving, self.candidate), after)
        self._waiting: dict[Follower, dict[int, _Answer]] = {self.serving: {}, self.candidate: {}}

    def _hear(self, follower: Follower, arrivals: Sequence[Arrival]) -> None:
        if self.verdict is not None or not arrivals:
            return
        # known from the contest's beginning, or heard already: then the follower has gone back
        if arrivals[0].event.number <= self._heard[follower] and self.contest.rows:
            self._begin(max(self._heard.values()))
        for each in arrivals:
            if each.event.kind == "batch" and each.event.number > self._heard[follower]:
                self._answer(follower, each)
        self._heard[follower] = max(self._heard[follower], arrivals[-1].event.number)

    def _answer(self, follower: Follower, arrival: Arrival) -> None:
        rows, number = sample(arrival.rows), arrival.event.number
        if len(rows) == 0 or (follower.answering is follower.base and follower.number > follower.start):
            return  # nothing to predict, or what has been learnt is not solved for yet
        found = follower.answering.predict(rows.q, rows.dq, rows.ddq)
        own = _Answer(rows, arrival.event.received, (found.tau, found.tau_std, found.noise_std))
        other = self._waiting[self.candidate if follower is self.serving else self.serving].pop(number, None)
        if other is not None:
            self._compare(*(own, other) if follower is self.serving else (other, own))
            return
        waiting = self._waiting[follower]
        waiting[number] = own
        if len(waiting) > PENDING:
            del waiting[min(waiting)]

    def _compare(self, serving: _Answer, candidate: _Answer) -> None:
        if self.verdict is not None:
            return
        rows, at = serving.rows, serving.received
        contest = self.contest.step(rows.time, rows.tau, serving.predicted, candidate.predicted, at)
        self.contest, self.verdict = contest.judge(self.settings, at)


class Duels:
    """The contests in the learner process: one for each candidate of each model; for one thread."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self._duels: dict[str, list[Duel]] = {}
        self._told: dict[Duel, float] = {}

    def arrange(self, model: str, serving: Follower | None, candidates: Sequence[Follower]) -> None:
        """Let these followers of a model be in contest, and no others; contests under way go on."""
        going = {(duel.serving, duel.candidate): duel for duel in self._duels.pop(model, [])}
        wanted = [] if serving is None else [(serving, candidate) for candidate in candidates]
        for pair, duel in going.items():
            if pair not in wanted:
                duel.close()
                self._told.pop(duel, None)
        if wanted:
            self._duels[model] = [going.get(pair) or Duel(*pair, self.settings) for pair in wanted]

    def outcomes(self) -> Iterator[Contested]:
        """Verdicts that have not been told yet, or not lately: the service may not have been able to act on them."""
        now = time.monotonic()
        for duel in (each for duels in self._duels.values() for each in duels):
            if now - self._told.get(duel, -inf) >= TELL_EVERY_S and (found := duel.outcome()) is not None:
                self._told[duel] = now
                yield found

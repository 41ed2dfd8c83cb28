"""A contest between the version that serves and a refreshed one: both predict the same rows before either learns them.

What is compared is the negative log predictive density of a row's torques, summed over the joints, with the noise that
each version states: it rewards small errors and honest uncertainty alike. The difference of neighbouring rows is
correlated, because a robot moves on where it was: the standard error is that of `lipcore.paired`, from blocks of at
least BLOCK_S seconds, which grow with the contest: from MAX_BLOCKS on, two become one. Looking again and again would
let chance promote in the end: looks are taken at `promotion_rows`, at twice as many, at four times as many …, and each
asks for more than the one before.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Any, Literal

import numpy as np

from lipcore.data.metrics import BLOCK_S, MAX_BLOCKS, Answer, Difference, of_blocks, surprise
from lipcore.data.samples import Array
from lipcore.online.batch import Rows
from lipcore.online.record import Record
from service.foundation.fields import finite
from service.foundation.settings import Settings
from service.learning.learner.follower import Follower
from service.learning.learner.publication import Contested
from service.learning.learner.restore import Arrival

Verdict = Literal["promote", "dismiss"]

ROWS_PER_BATCH = 20
"""Most rows of a batch that are compared: neighbours tell the same, and each costs two predictions."""
MIN_BLOCKS = 30
"""Fewest blocks that a verdict stands on."""
CHANCE = 0.02275
"""Probability that chance alone lies two standard errors above zero, which the first look takes as the bound."""
PENDING = 2000
"""Events that one follower may be ahead of the other before the oldest is dropped uncompared."""
REPEAT_EVERY_S = 30.0
"""Seconds after which a verdict that nothing has followed from is sent again."""


@dataclass(frozen=True)
class Block:
    """Rows of one stretch of event time: their number and the sum of their differences, nats."""

    rows: int
    total: float

    def __add__(self, other: Block) -> Block:
        return Block(self.rows + other.rows, self.total + other.total)


@dataclass(frozen=True)
class Contest:
    """What has been compared so far; immutable.

    serving, candidate: prequential sums of both versions over the rows compared; blocks: by number, event time divided
    by `length` in s; began: Unix time of the first comparison, s; looks: how often a verdict was sought.
    """

    serving: Record
    candidate: Record
    blocks: Mapping[int, Block]
    length: float = BLOCK_S
    began: float | None = None
    looks: int = 0

    @classmethod
    def start(cls, n_joints: int) -> Contest:
        """A contest without a row."""
        return cls(Record.empty(n_joints), Record.empty(n_joints), {})

    def step(self, time: Array, tau: Array, serving: Answer, candidate: Answer, at: float) -> Contest:
        """Add rows with event times (N,) s, measured torques (N, n), and the predictions of both versions. at: Unix
        time, s."""
        difference = (surprise(tau, serving) - surprise(tau, candidate)).sum(axis=1)
        blocks = dict(self.blocks)
        for number, value in zip(
            np.floor(time / self.length).astype(np.int64).tolist(), difference.tolist(), strict=True
        ):
            blocks[number] = blocks.get(number, Block(0, 0.0)) + Block(1, value)
        length = self.length
        while len(blocks) > MAX_BLOCKS:
            blocks, length = _paired(blocks), 2 * length
        return replace(
            self,
            serving=self.serving + Record.of(tau, *serving),
            candidate=self.candidate + Record.of(tau, *candidate),
            blocks=blocks,
            length=length,
            began=at if self.began is None else self.began,
        )

    @property
    def rows(self) -> int:
        """Rows compared."""
        return sum(block.rows for block in self.blocks.values())

    @property
    def gain(self) -> float:
        """How much better the candidate predicts a row, mean in nats; NaN without rows."""
        return float(self._difference().mean[0]) if self.blocks else float("nan")

    @property
    def standard_error(self) -> float:
        """Standard error of `gain`, nats; infinite with fewer than two blocks."""
        return float(self._difference().standard_error[0]) if self.blocks else float("inf")

    def judge(self, settings: Settings, at: float) -> tuple[Contest, Verdict | None]:
        """Return the contest after a look at it, and its verdict if there is one; at: Unix time, s.

        "promote" where the candidate is better by more than `bound` standard errors on at least `promotion_rows` rows;
        "dismiss" where it is worse by as much on twice the rows, or not better after `promotion_patience_s`.
        """
        over = self.began is not None and at - self.began >= settings.promotion_patience_s
        enough = self.rows >= settings.promotion_rows and len(self.blocks) >= MIN_BLOCKS
        if enough and (over or self.rows >= settings.promotion_rows * 2**self.looks):
            margin = self.bound() * self.standard_error
            looked = replace(self, looks=self.looks + 1)
            if self.gain > margin:
                return looked, "promote"
            worse = self.rows >= 2 * settings.promotion_rows and self.gain < -margin
            return looked, "dismiss" if worse or over else None
        return self, "dismiss" if over else None

    def bound(self) -> float:
        """Standard errors that the next look asks for: two at first, more the more looks there were.

        Each look may be wrong half as often as the one before, so that equal versions are taken for different with a
        probability below 2 · CHANCE, however long the contest. Student's quantile accounts for few blocks.
        """
        from scipy.special import stdtrit  # noqa: PLC0415 - most learners compare no versions

        return float(-stdtrit(self._difference().freedom[0], CHANCE / 2**self.looks))

    def evidence(self) -> dict[str, Any]:
        """What the verdict stands on, as JSON: differences in nats a row, metrics per joint of both versions."""
        return {
            "rows": self.rows,
            "gain": self.gain,
            "standard_error": self.standard_error,
            "blocks": len(self.blocks),
            "block_s": self.length,
            "looks": self.looks,
            "figures": {"serving": _figures(self.serving), "candidate": _figures(self.candidate)},
        }

    def _difference(self) -> Difference:
        """Serving's surprise at a row less the candidate's, from the blocks, of which there is at least one."""
        blocks = [self.blocks[number] for number in sorted(self.blocks)]
        return of_blocks(np.array([block.rows for block in blocks]), np.array([[block.total] for block in blocks]))


def sample(rows: Rows) -> Rows:
    """At most ROWS_PER_BATCH of the rows that teach, evenly."""
    learnt = rows.learnt
    count = min(len(learnt), ROWS_PER_BATCH)
    return learnt.take(np.linspace(0, len(learnt) - 1, count).round().astype(np.int64))


def _paired(blocks: Mapping[int, Block]) -> dict[int, Block]:
    merged: dict[int, Block] = {}
    for number, block in blocks.items():
        merged[number // 2] = merged.get(number // 2, Block(0, 0.0)) + block
    return merged


def _figures(record: Record) -> dict[str, list[float | None]]:
    """nMSE and coverage per joint; null where the torque did not vary."""
    figures = {"nmse": record.nmse, "coverage": record.coverage}
    return {name: finite(values) for name, values in figures.items()}


@dataclass(frozen=True)
class _Entry:
    """A follower's prediction of rows of an event; received: Unix time, s."""

    rows: Rows
    received: float
    predicted: Answer


class Duel:
    """Contest of the version that serves with a candidate; for one thread.

    Both followers pass it each batch before they learn it, so that both predict it unseen. Batches that only one has
    passed, since the other had learnt them before the duel began, are left out. Where the log is rewound, the contest
    begins anew.
    """

    def __init__(self, serving: Follower, candidate: Follower, settings: Settings) -> None:
        self.serving, self.candidate, self.settings = serving, candidate, settings
        self.verdict: Verdict | None = None
        self._begin(max(serving.number, candidate.number))
        for follower in (serving, candidate):
            follower.watchers.append(self._enter)

    def close(self) -> None:
        """Take no more batches from the followers."""
        for follower in (self.serving, self.candidate):
            follower.watchers.remove(self._enter)

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
        self._reached = dict.fromkeys((self.serving, self.candidate), after)
        self._waiting: dict[Follower, dict[int, _Entry]] = {self.serving: {}, self.candidate: {}}

    def _enter(self, follower: Follower, arrivals: Sequence[Arrival]) -> None:
        if self.verdict is not None or not arrivals:
            return
        # passed before the contest began, or already: then the follower has gone back
        if arrivals[0].event.number <= self._reached[follower] and self.contest.rows:
            self._begin(max(self._reached.values()))
        for each in arrivals:
            if each.event.kind == "batch" and each.event.number > self._reached[follower]:
                self._predict(follower, each)
        self._reached[follower] = max(self._reached[follower], arrivals[-1].event.number)

    def _predict(self, follower: Follower, arrival: Arrival) -> None:
        rows, number = sample(arrival.rows), arrival.event.number
        if len(rows) == 0 or (follower.answering is follower.base and follower.number > follower.start):
            return  # nothing to predict, or what has been learnt is not solved for yet
        prediction = follower.answering.predict(rows.q, rows.dq, rows.ddq)
        answer = prediction.interval
        own = _Entry(rows, arrival.event.received, answer)
        other = self._waiting[self.candidate if follower is self.serving else self.serving].pop(number, None)
        if other is not None:
            self._compare(*(own, other) if follower is self.serving else (other, own))
            return
        waiting = self._waiting[follower]
        waiting[number] = own
        if len(waiting) > PENDING:
            del waiting[min(waiting)]

    def _compare(self, serving: _Entry, candidate: _Entry) -> None:
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
        self._sent: dict[Duel, float] = {}

    def arrange(self, model: str, serving: Follower | None, candidates: Sequence[Follower]) -> None:
        """Let these followers of a model be in contest, and no others; contests under way go on."""
        going = {(duel.serving, duel.candidate): duel for duel in self._duels.pop(model, [])}
        pairs = [] if serving is None else [(serving, candidate) for candidate in candidates]
        for pair, duel in going.items():
            if pair not in pairs:
                duel.close()
                self._sent.pop(duel, None)
        if pairs:
            self._duels[model] = [going.get(pair) or Duel(*pair, self.settings) for pair in pairs]

    def outcomes(self) -> Iterator[Contested]:
        """Verdicts that have not been sent yet, or not lately: the service may not have been able to act on them."""
        now = time.monotonic()
        for duel in (each for duels in self._duels.values() for each in duels):
            if now - self._sent.get(duel, -inf) >= REPEAT_EVERY_S and (outcome := duel.outcome()) is not None:
                self._sent[duel] = now
                yield outcome

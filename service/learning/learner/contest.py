"""A contest between the version that serves and a refreshed one: both predict the same rows before either learns them.

What is compared is the negative log predictive density of a row's torques, summed over the joints, with the noise that
each version states: it rewards small errors and honest uncertainty alike. The difference of neighbouring rows is
correlated, because a robot moves on where it was: the standard error therefore comes from the means of blocks of at
least BLOCK_S seconds, which grow with the contest (from MAX_BLOCKS on, two become one), and whatever correlation is
left between neighbouring blocks widens it further. Looking again and again would let chance promote in the end: looks
are taken at `promotion_rows`, at twice as many, at four times as many …, and each asks for more than the one before.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Any, Literal

import numpy as np
from scipy.special import stdtrit

from lipcore.online.batch import Rows
from lipcore.online.record import Record
from lipcore.samples import Array
from service.foundation.settings import Settings
from service.learning.learner.follower import Follower
from service.learning.learner.publication import Contested
from service.learning.learner.restore import Arrival

Verdict = Literal["promote", "dismiss"]

ROWS_PER_BATCH = 20
"""Most rows of a batch that are compared: neighbours tell the same, and each costs two predictions."""
BLOCK_S = 1.0
"""Shortest block, s of event time."""
MIN_BLOCKS, MAX_BLOCKS = 30, 64
"""Fewest blocks that a verdict stands on, and most that are kept."""
CHANCE = 0.02275
"""Probability that chance alone lies two standard errors above zero, which the first look takes as the bound."""
PENDING = 2000
"""Events that one follower may be ahead of the other before the oldest is dropped uncompared."""
TELL_EVERY_S = 30.0
"""Seconds after which a verdict that nothing has followed from is told again."""


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

    def step(
        self, time: Array, tau: Array, serving: tuple[Array, ...], candidate: tuple[Array, ...], at: float
    ) -> Contest:
        """Add rows with event times (N,) s, measured torques (N, n), and (mean, std, noise std) of both versions."""
        difference = surprise(tau, *serving) - surprise(tau, *candidate)
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
        rows = self.rows
        return sum(block.total for block in self.blocks.values()) / rows if rows else float("nan")

    @property
    def standard_error(self) -> float:
        """Standard error of `gain`, nats; infinite with fewer than two blocks.

        With S_b the sums and N_b the rows of B blocks: se² = B/(B−1) Σ (S_b − N_b gain)² / N², times (1+ρ)/(1−ρ) for
        the correlation ρ > 0 of neighbouring blocks.
        """
        blocks = [self.blocks[number] for number in sorted(self.blocks)]
        if len(blocks) < 2:
            return float("inf")
        gain = self.gain
        deviation = np.array([block.total - block.rows * gain for block in blocks])
        squared = float(deviation @ deviation)
        if squared == 0:
            return 0.0
        correlation = min(max(float(deviation[1:] @ deviation[:-1]) / squared, 0.0), 0.9)
        inflation = (1 + correlation) / (1 - correlation)
        return float(np.sqrt(len(blocks) / (len(blocks) - 1) * squared * inflation) / self.rows)

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
        return float(-stdtrit(len(self.blocks) - 1, CHANCE / 2**self.looks))

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


def sample(rows: Rows) -> Rows:
    """At most ROWS_PER_BATCH of the rows that teach, evenly."""
    learnt = rows.learnt
    count = min(len(learnt), ROWS_PER_BATCH)
    return learnt.take(np.linspace(0, len(learnt) - 1, count).round().astype(np.int64))


def surprise(tau: Array, mean: Array, std: Array, noise_std: Array) -> Array:
    """Negative log predictive density of each row, summed over its joints, (N,) nats."""
    variance = std**2 + noise_std**2
    density = 0.5 * (np.log(2 * np.pi * variance) + (tau - mean) ** 2 / variance)
    return np.asarray(density.sum(axis=1))


def _paired(blocks: Mapping[int, Block]) -> dict[int, Block]:
    merged: dict[int, Block] = {}
    for number, block in blocks.items():
        merged[number // 2] = merged.get(number // 2, Block(0, 0.0)) + block
    return merged


def _figures(record: Record) -> dict[str, list[float | None]]:
    """nMSE and coverage per joint; null where the torque did not vary."""
    figures = {"nmse": record.nmse, "coverage": record.coverage}
    return {name: [v if np.isfinite(v) else None for v in values.tolist()] for name, values in figures.items()}


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

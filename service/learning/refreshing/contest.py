"""A contest between the version that serves and a refreshed one: both predict the same rows before either learns them.

What is compared is the negative log predictive density of a row's torques, summed over the joints, with the noise that
each version states: it rewards small errors and honest uncertainty alike. The difference of neighbouring rows is
correlated, because a robot moves on where it was: the standard error therefore comes from the means of blocks of at
least BLOCK_S seconds, which grow with the contest (from MAX_BLOCKS on, two become one), and whatever correlation is
left between neighbouring blocks widens it further. Looking again and again would let chance promote in the end: looks
are taken at `promotion_rows`, at twice as many, at four times as many …, and each asks for more than the one before.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.special import stdtrit

from lipcore.data.samples import Array
from lipcore.online.batch import Rows
from lipcore.online.record import Record
from service.foundation.settings import Settings

Verdict = Literal["promote", "dismiss"]

ROWS_PER_BATCH = 20
"""Most rows of a batch that are compared: neighbours tell the same, and each costs two predictions."""
BLOCK_S = 1.0
"""Shortest block, s of event time."""
MIN_BLOCKS, MAX_BLOCKS = 30, 64
"""Fewest blocks that a verdict stands on, and most that are kept."""
CHANCE = 0.02275
"""Probability that chance alone lies two standard errors above zero, which the first look takes as the bound."""


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

"""The scale of a stream's intervals, and what intervals held."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.online.adaptive import Adaptive, outside
from lipcore.online.screening import Seen


@dataclass(frozen=True)
class ScaleRecord:
    """The scale of a stream's intervals after its last batch, which a version predicted: `state` of all measurements,
    `accepted` of those that were not kept out, which is what others are answered with."""

    state: Adaptive
    accepted: Adaptive
    version: int

    @classmethod
    def start(cls, own: Array, version: int) -> ScaleRecord:
        """Before the first row, from the version's `own` scale, (n,)."""
        return cls(Adaptive.start(own), Adaptive.start(own), version)

    def step(self, seen: Seen, accepted: NDArray[np.bool_]) -> ScaleRecord:
        """Follow measurements (M, n). accepted: (M,), of rows that were not kept out."""
        factors = answered_with(self.state, seen)
        given = seen.score[accepted], None if seen.factor is None else seen.factor[accepted]
        state = self.state.step(seen.time, seen.score, factors)
        return replace(self, state=state, accepted=self.accepted.step(seen.time[accepted], *given))

    def to_json(self) -> dict[str, Any]:
        """As the stream's record has it."""
        return {"state": self.state.to_json(), "accepted": self.accepted.to_json(), "version": self.version}

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> ScaleRecord:
        """Read what `to_json` wrote, or an earlier release, which knew one state."""
        state, accepted = (
            Adaptive.from_json(each) for each in (values["state"], values.get("accepted") or values["state"])
        )
        return ScaleRecord(state, accepted, values["version"])


@dataclass(frozen=True)
class HeldIntervals:
    """What intervals of promised 95 %, as answered, held: `inside`, (n,), of `rows` measurements. They add."""

    rows: int
    inside: Array

    @staticmethod
    def none(n: int) -> HeldIntervals:
        """Of no rows of n joints."""
        return HeldIntervals(0, np.zeros(n))

    @staticmethod
    def of(state: Adaptive, seen: Seen) -> HeldIntervals:
        """Of the rows of a batch, by the scale before it. Every measurement counts: those of contacts, of rows that
        wait for a decision, and of rows at rest."""
        rows, off = len(seen.score), outside(seen.score, answered_with(state, seen)).sum(axis=0)
        return HeldIntervals(rows, rows - off)

    def __add__(self, other: HeldIntervals) -> HeldIntervals:
        return HeldIntervals(self.rows + other.rows, self.inside + other.inside)

    def coverage(self) -> list[float | None]:
        """Share of measurements inside, per joint; None without rows."""
        return [number / self.rows if self.rows else None for number in self.inside.tolist()]

    def to_json(self) -> dict[str, Any]:
        """Return both fields as JSON has them."""
        return {"rows": self.rows, "inside": self.inside.tolist()}

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> HeldIntervals:
        """Read what `to_json` returned."""
        return HeldIntervals(values["rows"], np.array(values["inside"], np.float64))


def answered_with(state: Adaptive, seen: Seen) -> Array:
    """The factors on half widths that rows were answered with: (n,), or (N, n) where a stream was answered."""
    return state.factor if seen.factor is None else seen.factor

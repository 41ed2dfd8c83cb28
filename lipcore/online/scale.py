"""Track the scale of a stream's intervals and their coverage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.online.adaptive import AdaptiveScale, outside
from lipcore.online.screening import IntervalScores


@dataclass(frozen=True)
class ScaleRecord:
    """The scale of a stream's intervals after its last batch, and the `version` that predicted it."""

    state: AdaptiveScale
    """Follows all measurements."""
    accepted: AdaptiveScale
    """Follows the rows that were not rejected; used for queries without this stream."""
    version: int

    @classmethod
    def start(cls, own: Array, version: int) -> ScaleRecord:
        """Return the record before the first row. own: the version's scale, (n,)."""
        return cls(AdaptiveScale.start(own), AdaptiveScale.start(own), version)

    def step(self, seen: IntervalScores, accepted: NDArray[np.bool_]) -> ScaleRecord:
        """Return the record after M measurements. accepted: rows that were not rejected, (M,)."""
        factors = applied_factor(self.state, seen)
        given = seen.score[accepted], None if seen.factor is None else seen.factor[accepted]
        state = self.state.step(seen.time, seen.score, factors)
        return replace(self, state=state, accepted=self.accepted.step(seen.time[accepted], *given))

    def to_json(self) -> dict[str, Any]:
        """Return the fields as the stream's record stores them."""
        return {"state": self.state.to_json(), "accepted": self.accepted.to_json(), "version": self.version}

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> ScaleRecord:
        """Read what `to_json` returned, or an earlier release with one state."""
        state, accepted = (
            AdaptiveScale.from_json(each) for each in (values["state"], values.get("accepted") or values["state"])
        )
        return ScaleRecord(state, accepted, values["version"])


@dataclass(frozen=True)
class IntervalCoverage:
    """Coverage of the 95 % intervals that were returned. Two add up."""

    rows: int
    """Number of measurements."""
    inside: Array
    """Number of measurements inside, (n,)."""
    factors: Array
    """Sum of the factors on the half widths, (n,)."""

    @staticmethod
    def none(n: int) -> IntervalCoverage:
        """Return the coverage of no rows of n joints."""
        return IntervalCoverage(0, np.zeros(n), np.zeros(n))

    @staticmethod
    def of(state: AdaptiveScale, seen: IntervalScores) -> IntervalCoverage:
        """Return the coverage of a batch, by the scale before it.

        Every measurement counts: contacts, rows that await a decision, and rows at rest.
        """
        rows, factor = len(seen.score), np.broadcast_to(applied_factor(state, seen), seen.score.shape)
        return IntervalCoverage(rows, rows - outside(seen.score, factor).sum(axis=0), factor.sum(axis=0))

    def __add__(self, other: IntervalCoverage) -> IntervalCoverage:
        return IntervalCoverage(self.rows + other.rows, self.inside + other.inside, self.factors + other.factors)

    def coverage(self) -> list[float | None]:
        """Return the share of measurements inside, per joint; None without rows."""
        return [number / self.rows if self.rows else None for number in self.inside.tolist()]

    def to_json(self) -> dict[str, Any]:
        """Return all fields for JSON."""
        return {"rows": self.rows, "inside": self.inside.tolist(), "factors": self.factors.tolist()}

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> IntervalCoverage:
        """Read what `to_json` returned, or an earlier release without `factors`: its factors count as 1."""
        rows, inside = values["rows"], np.array(values["inside"], np.float64)
        return IntervalCoverage(rows, inside, np.array(values.get("factors", [float(rows)] * len(inside)), np.float64))


def applied_factor(state: AdaptiveScale, seen: IntervalScores) -> Array:
    """Return the factors on the half widths of returned intervals: (n,), or (N, n) if the stream returned them."""
    return state.factor if seen.factor is None else seen.factor

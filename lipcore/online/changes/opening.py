"""The first second of a stream: whether it fits what the model believes at all.

Changes are told by comparing a stream's errors with those before them. A stream that is wrong from its first row on,
of another robot or one with other friction, has none before: what it opens with is compared with the stated intervals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lipcore.data.coverage import clopper_pearson
from lipcore.data.samples import Array


@dataclass(frozen=True)
class OpeningOptions:
    """How long an opening is, and what intervals hold of one that fits."""

    rows: float = 10.0
    """Effective rows (`lipcore.data.independence`): a second, of a stream of ten rows a second and more."""
    band: float = 1.959963984540054
    """Standard deviations on both sides that hold 95 %."""
    min_share: float = 0.5
    """Min share of the measurements of all joints inside the 95 % intervals, as far as so few rows tell: with ten, up
    to 15 % are too few. Half, and not 95 %, as errors last for seconds where friction is not quite as learnt, and a
    payload takes a third of a second to be noticed."""


OPENING = OpeningOptions()


@dataclass(frozen=True)
class Opening:
    """What the intervals of a model held of a stream's first effective rows; immutable.

    rows: effective rows so far; inside: those whose torque the joint's 95 % interval held, (n,); since: event time of
    the first, s, None where there is none yet.
    """

    rows: float
    inside: Array
    since: float | None = None

    @staticmethod
    def start(n: int) -> Opening:
        """Of a stream of n joints that has just begun."""
        return Opening(0.0, np.zeros(n))

    def step(self, time: Array, weight: Array, error: Array, spread: Array) -> Opening:
        """Take in rows until there are enough. time: (N,) s; weight: (N,) effective rows; error: tau − mean, (N, n);
        spread: standard deviation of a measurement as stated, its scale included, (N, n), N·m."""
        before = self.rows + np.cumsum(weight) - weight
        taken = before < OPENING.rows
        if not taken.any():
            return self
        held = weight[taken, None] * (np.abs(error) <= OPENING.band * spread)[taken]
        since = float(time[taken][0]) if self.since is None else self.since
        return Opening(self.rows + float(weight[taken].sum()), self.inside + held.sum(axis=0), since)

    @property
    def over(self) -> bool:
        """Whether it is complete, and can be judged."""
        return self.rows >= OPENING.rows * (1 - 1e-9)

    @property
    def coverage(self) -> Array:
        """Share of each joint's measurements that its interval held, (n,); 0 before the first row."""
        return np.asarray(self.inside / max(self.rows, 1e-9))

    @property
    def misfit(self) -> bool:
        """Whether it is complete, and the share that was held is known to be too small.

        Joints share their motion: their mean counts for as many trials as there are effective rows, and no more.
        """
        _, high = clopper_pearson(np.array([self.coverage.mean()]), np.array([self.rows]))
        return self.over and bool(high[0] < OPENING.min_share)

    @property
    def joints(self) -> tuple[int, ...]:
        """Joints whose intervals held less than the min share."""
        return tuple(int(joint) for joint in np.flatnonzero(self.coverage < OPENING.min_share))

    def evidence(self, joint_names: Sequence[str]) -> dict[str, Any]:
        """What speaks against the stream, for JSON: the share of its first second that the 95 % intervals held."""
        per_joint = dict(zip(joint_names, self.coverage.tolist(), strict=True))
        return {
            "kind": "opening",
            "cause": "the stream's first second lies outside the band",
            "coverage": float(self.coverage.mean()),
            "joint_coverage": per_joint,
        }

    def to_json(self) -> dict[str, Any]:
        """All fields as numbers and lists; `from_json` gives back the same to the last bit."""
        return {"rows": self.rows, "inside": self.inside.tolist(), "since": self.since}

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> Opening:
        """What `to_json` wrote."""
        return Opening(float(values["rows"]), np.array(values["inside"], np.float64), values["since"])

"""Check whether the first second of a stream fits the model at all.

Changes are detected by comparing a stream's errors with earlier ones. A stream that is wrong from its first row, from
another robot or one with other friction, has no earlier errors. Its first second is compared with the stated intervals.
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
    """Length of an opening, and the min coverage of one that fits."""

    rows: float = 10.0
    """Effective rows (`lipcore.data.independence`): a second, of a stream of ten rows per second and more."""
    band: float = 1.959963984540054
    """Half width of the 95 % interval, in standard deviations."""
    min_share: float = 0.5
    """Min coverage of the 95 % intervals, mean over joints, within the certainty of so few rows: of ten, up to 15 % are
    too few. It is half and not 95 %: errors last for seconds if friction is not quite as learnt, and a payload takes a
    third of a second to be noticed."""


OPENING = OpeningOptions()


@dataclass(frozen=True)
class Opening:
    """Coverage of the intervals of a model in a stream's first effective rows; immutable."""

    rows: float
    """Effective rows so far."""
    inside: Array
    """Those with the torque inside the joint's 95 % interval, (n,)."""
    since: float | None = None
    """Event time of the first row, s; None before it."""

    @staticmethod
    def start(n: int) -> Opening:
        """Return the opening of a new stream of n joints."""
        return Opening(0.0, np.zeros(n))

    def step(self, time: Array, weight: Array, error: Array, spread: Array) -> Opening:
        """Add rows until there are enough.

        time: (N,) s; weight: (N,) effective rows; error: tau − mean, (N, n); spread: standard deviation of a
        measurement as stated, its scale included, (N, n), N·m.
        """
        before = self.rows + np.cumsum(weight) - weight
        taken = before < OPENING.rows
        if not taken.any():
            return self
        held = weight[taken, None] * (np.abs(error) <= OPENING.band * spread)[taken]
        since = float(time[taken][0]) if self.since is None else self.since
        return Opening(self.rows + float(weight[taken].sum()), self.inside + held.sum(axis=0), since)

    @property
    def is_complete(self) -> bool:
        """Whether it is complete and can be judged."""
        return self.rows >= OPENING.rows * (1 - 1e-9)

    @property
    def coverage(self) -> Array:
        """Return the share of measurements inside the interval per joint, (n,); 0 before the first row."""
        return np.asarray(self.inside / max(self.rows, 1e-9))

    @property
    def is_misfit(self) -> bool:
        """Whether it is complete and its coverage is certainly too small.

        Joints share their motion: their mean counts for as many trials as there are effective rows, and no more.
        """
        _, high = clopper_pearson(np.array([self.coverage.mean()]), np.array([self.rows]))
        return self.is_complete and bool(high[0] < OPENING.min_share)

    @property
    def joints(self) -> tuple[int, ...]:
        """Return the joints with coverage below the min share."""
        return tuple(int(joint) for joint in np.flatnonzero(self.coverage < OPENING.min_share))

    def evidence(self, joint_names: Sequence[str]) -> dict[str, Any]:
        """Return the evidence against the stream for JSON: the coverage of its first second."""
        per_joint = dict(zip(joint_names, self.coverage.tolist(), strict=True))
        return {
            "kind": "opening",
            "cause": "coverage of the stream's first second is too low",
            "coverage": float(self.coverage.mean()),
            "joint_coverage": per_joint,
        }

    def to_json(self) -> dict[str, Any]:
        """Return all fields as numbers and lists; `from_json` restores them to the last bit."""
        return {"rows": self.rows, "inside": self.inside.tolist(), "since": self.since}

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> Opening:
        """Read what `to_json` returned."""
        return Opening(float(values["rows"]), np.array(values["inside"], np.float64), values["since"])

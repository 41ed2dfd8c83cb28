"""Figures of a stream while it is played: of one second, and, merged, of all of it."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from lipcore.data.samples import Array
from service.stream.messages import StreamAnswer, StreamLearnt

BAND = 1.959963984540054
"""Standard deviations on both sides that hold 95 %."""


class Tally:
    """What answers were like, as sums: a stream may last for hours. noise_std: (n) N·m, of a measurement."""

    def __init__(self, noise_std: Array) -> None:
        self._noise = noise_std
        self.rows, self.late, self.behind_s = 0, 0, 0.0
        self.refused = Counter[str]()
        self._trips = array("d")
        self._inside, self._squared, self._sum, self._sum_squared = np.zeros((4, len(noise_std)))

    def add(self, answer: StreamAnswer, tau: Array, seconds: float, behind_s: float) -> None:
        """Count an answer with its std.

        tau: (n) measured there; seconds: of the round trip; behind_s: how long after it was due the row was sent.
        """
        error = tau - answer.tau
        self.rows += 1
        self.late += answer.late
        self.behind_s = max(self.behind_s, behind_s)
        self._trips.append(seconds)
        self._squared += error**2
        self._sum += tau
        self._sum_squared += tau**2
        if answer.tau_std is not None:
            self._inside += np.abs(error) <= BAND * np.hypot(answer.tau_std, self._noise)

    def merge(self, other: Tally) -> None:
        """Add the figures of another stretch of the same stream."""
        self.rows += other.rows
        self.late += other.late
        self.behind_s = max(self.behind_s, other.behind_s)
        self.refused.update(other.refused)
        self._trips.extend(other._trips)
        self._inside += other._inside
        self._squared += other._squared
        self._sum += other._sum
        self._sum_squared += other._sum_squared

    def shown(self) -> dict[str, Any]:
        """The figures for JSON: rmse in N·m over all joints, coverage of the 95 % band; None without answers.

        All compare answers with torque that the model had not learnt yet when it answered.
        """
        p50, p99 = (np.percentile(self._trips, (50, 99)) * 1e3).tolist() if self.rows else (None, None)
        return {
            "rows": self.rows,
            "refused": dict(self.refused),
            "round_trip_ms": {"p50": p50, "p99": p99},
            "late": self.late,
            "behind_s": self.behind_s,
            "rmse": float(np.sqrt(self._squared.mean() / self.rows)) if self.rows else None,
            "coverage": float(self._inside.mean() / self.rows) if self.rows else None,
        }

    def joints(self, joint_names: Sequence[str]) -> list[dict[str, Any]]:
        """Figures of each joint: rmse N·m, nmse (None where the torque does not vary), coverage of the 95 % band."""
        if not self.rows:
            return []
        squared, coverage = self._squared / self.rows, self._inside / self.rows
        variance = self._sum_squared / self.rows - (self._sum / self.rows) ** 2
        return [
            {
                "joint": name,
                "rmse": float(np.sqrt(squared[at])),
                "nmse": float(squared[at] / variance[at]) if variance[at] > 1e-12 else None,
                "coverage": float(coverage[at]),
            }
            for at, name in enumerate(joint_names)
        ]


def learnt_shown(learnt: StreamLearnt) -> dict[str, Any]:
    """What has become of the torques that were sent, for JSON."""
    return {
        "accepted": learnt.accepted,
        "duplicates": learnt.duplicates,
        "kept_out": dict(learnt.rejected),
        "revision": learnt.revision,
    }

"""Detect that a model drifts away from the version as trained, in steps that each look harmless.

A change detector compares errors with earlier errors, and both follow what is learnt. Whoever labels each batch
slightly above the prediction can move the prediction as far as they like, and no error ever grows. The version as
trained does not follow. Its prediction and stated uncertainty are compared with the same rows here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lipcore.data.samples import Array


@dataclass(frozen=True)
class DepartureOptions:
    """Limits of the sums that detect a departure.

    All were tuned on 300 s each of slow and fast motion of a double pendulum (arms 1 to 3) and a UR5 (arms 1 and 2)
    with `Dirt`, trained on 60 s, where the sums reached 28. The other case had labels one standard deviation above
    every prediction (seeds 1, 2 and 11 to 13).
    """

    stated: float = 1.0
    """Max error of the trained version's mean, in standard deviations of its function. Errors of the mean
    persist; errors of the noise average out."""
    slack: float = 0.5
    """Mean standardised error that is ignored in addition."""
    max_error: float = 1.0
    """Max standardised error of a row. Gates reject rows that are far off. A misfit that lasts for seconds, as in slow
    moves with stiction, would otherwise add up like independent rows."""
    bound: float = 36.0
    """Bound of the sums, in effective rows: errors of one standard deviation pass it after 72 rows, 7 s, if the
    function is certain."""


OPTIONS = DepartureOptions()


@dataclass(frozen=True, eq=False)
class Departure:
    """Two-sided CUSUM of standardised errors against a version as trained; immutable, per model.

    Let u = (tau − mean) / √(std² + noise²), with mean and std of the version as trained. c is its accepted mean, and r
    the share of std in the root. A row of weight w adds

        S± ← max(0, S± + w (±(u − c) − slack − stated r)),    u − c clipped to ±max_error,

    so that only errors beyond the stated uncertainty add up. Weights count effective rows (`data.independence`). Once S
    exceeds the bound the alarm is raised, once, until `decided`.
    """

    version: int
    """Number of the version."""
    retired: bool
    """Whether the robot is known to differ from the one trained on, so that nothing is compared any more."""
    above: Array
    """S+, (n,); `below` is S−."""
    below: Array
    total: Array
    """Sum of w (u − c) since both sums were last 0 at the joint, (n,)."""
    rows: Array
    """Sum of w since then, (n,)."""
    since: Array
    """Event time of then, s, (n,)."""
    centre: Array
    """c, (n,)."""

    @staticmethod
    def start(version: int, n: int) -> Departure:
        """Return the departure of a version of n joints before the first row."""
        return Departure(version, False, *(np.zeros(n) for _ in ARRAY_FIELDS))

    def step(self, time: Array, weight: Array, error: Array, std: Array, noise_std: Array) -> Departure:
        """Add rows.

        time: (N,) s; weight: (N,) effective rows; error: tau − mean, (N, n); std: (N, n); noise_std: (n,), all N·m.
        """
        if self.retired or not len(time):
            return self
        spread = np.sqrt(std**2 + noise_std**2)
        error = error / spread - self.centre
        ratio = np.clip(error, -OPTIONS.max_error, OPTIONS.max_error)
        slack, weighs = OPTIONS.slack + OPTIONS.stated * std / spread, weight[:, None]
        above, below = (_reflect(weighs * (sign * ratio - slack), start) for sign, start in self._sides)
        idle = (above == 0) & (below == 0)
        count, rows = len(time), np.arange(len(time))[:, None]
        # each joint's latest row before which both sums were 0; −1 if there is none in this batch
        began = np.where(np.vstack([(self.above == 0) & (self.below == 0), idle[:-1]]), rows, -1).max(axis=0)
        lately = rows >= began
        kept = began < 0
        return replace(
            self,
            above=above[-1],
            below=below[-1],
            total=np.where(kept, self.total, 0.0) + (weighs * error * lately).sum(axis=0),
            rows=np.where(kept, self.rows, 0.0) + (weighs * lately).sum(axis=0),
            since=np.where(kept, self.since, time[np.clip(began, 0, count - 1)]),
        )

    @property
    def _sides(self) -> tuple[tuple[float, Array], tuple[float, Array]]:
        return (1.0, self.above), (-1.0, self.below)

    @property
    def joints(self) -> tuple[int, ...]:
        """Return the joints with more drift of their torque than the version's uncertainty allows."""
        return tuple(int(joint) for joint in np.flatnonzero(self.level > OPTIONS.bound))

    @property
    def level(self) -> Array:
        """Return the larger of both sums, (n,), which must stay below the bound."""
        return np.maximum(self.above, self.below)

    @property
    def drift(self) -> Array:
        """Return the mean standardised error of each joint since `since`, (n,), beyond the accepted one."""
        return np.divide(self.total, self.rows, out=np.zeros_like(self.total), where=self.rows > 0)

    @property
    def began(self) -> float:
        """Return the event time since which the alarmed joints have drifted, s."""
        return float(self.since[list(self.joints)].min())

    def evidence(self, joint_names: Sequence[str]) -> dict[str, Any]:
        """Return the evidence for JSON: the version, and each alarmed joint's mean error in stated deviations."""
        drift = {joint_names[joint]: float(self.drift[joint]) for joint in self.joints}
        return {"cause": "drift against the trained version", "trained": {"version": self.version, "drift": drift}}

    def decided(self) -> Departure:
        """Return the departure after a change was decided about.

        If the change was this departure, the drift becomes the accepted mean. After any other change the robot is not
        the one trained on, and the departure is retired.
        """
        if not self.joints:
            return replace(self, retired=True)
        fresh = Departure.start(self.version, len(self.centre))
        return replace(fresh, centre=self.centre + np.where(self.level > OPTIONS.bound, self.drift, 0.0))

    def to_json(self) -> dict[str, Any]:
        """Return all fields as numbers and lists; `from_json` restores them to the last bit."""
        return {"version": self.version, "retired": self.retired} | {
            name: getattr(self, name).tolist() for name in ARRAY_FIELDS
        }

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> Departure:
        """Read what `to_json` returned."""
        numbers = (np.array(values[name], np.float64) for name in ARRAY_FIELDS)
        return Departure(int(values["version"]), bool(values["retired"]), *numbers)


ARRAY_FIELDS = ("above", "below", "total", "rows", "since", "centre")


def _reflect(steps: Array, start: Array) -> Array:
    """Return S after each of N steps, (N, n), with S ← max(0, S + step) from `start`, (n,): x + max(start, max −x)."""
    walked = np.cumsum(steps, axis=0)
    return walked + np.maximum(start, np.maximum.accumulate(-walked, axis=0))

"""A model that is led away from what it was trained on, by steps each of which looks harmless.

A change detector compares errors with those before them, and both follow what is learnt: whoever labels each batch a
little above what the model answers moves the answer as far as they like, and no error ever grows. What does not follow
is the version as trained. Its prediction and stated uncertainty are compared with the same rows here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lipcore.data.samples import Array


@dataclass(frozen=True)
class DepartureOptions:
    """Limits of the sums that find a departure.

    All were tuned on 300 s each of slow and fast motion of a double pendulum and a UR5 with `Dirt` (arms 1 to 3, and 1
    and 2), trained on 60 s, where the sums came up to 28, and on labels one standard deviation above every answer
    (seeds 1, 2 and 11 to 13).
    """

    stated: float = 1.0
    """Standard deviations by which the mean of the trained version may be off: those of its function, which are the
    same for long, and not those of the noise, which averages out."""
    slack: float = 0.5
    """Mean standardised error that is ignored besides."""
    max_error: float = 1.0
    """Max standardised error of a row: rows far off are what the gates are for, and a misfit that lasts for seconds, as
    of slow moves with stiction, would add up as if many had seen it."""
    bound: float = 36.0
    """Bound of the sums, in effective rows: errors of one standard deviation pass it after 72 of them, 7 s, where the
    function is sure."""


OPTIONS = DepartureOptions()


@dataclass(frozen=True, eq=False)
class Departure:
    """Two-sided CUSUM of standardised errors against a version as trained; immutable, per model.

    With u = (tau − mean) / √(std² + noise²), mean and std of the version as trained, c its accepted mean and r the
    share of std in the root, a row of weight w adds

        S± ← max(0, S± + w (±(u − c) − slack − stated r)),    u − c clipped to ±max_error,

    so that only what its stated uncertainty does not allow adds up. Weights count effective rows
    (`data.independence`). Once S exceeds the bound the alarm is raised, once, until `decided`.

    version: whose; retired: whether the robot is known to be another than it was trained on, so that nothing is
    compared with it any more; above, below: S+ and S−, (n,); total, rows: sums of w (u − c), (n,), and of w since both
    were 0 last at the joint, (n,); since: event time of then, s, (n,); centre: c, (n,).
    """

    version: int
    retired: bool
    above: Array
    below: Array
    total: Array
    rows: Array
    since: Array
    centre: Array

    @staticmethod
    def start(version: int, n: int) -> Departure:
        """Of a version of n joints, nothing seen yet."""
        return Departure(version, False, *(np.zeros(n) for _ in NUMBERS))

    def step(self, time: Array, weight: Array, error: Array, std: Array, noise_std: Array) -> Departure:
        """Take in rows. time: (N,) s; weight: (N,) effective rows; error: tau − mean, (N, n); std: (N, n); noise_std:
        (n,), all N·m."""
        if self.retired or not len(time):
            return self
        spread = np.sqrt(std**2 + noise_std**2)
        error = error / spread - self.centre
        ratio = np.clip(error, -OPTIONS.max_error, OPTIONS.max_error)
        slack, weighs = OPTIONS.slack + OPTIONS.stated * std / spread, weight[:, None]
        above, below = (_reflected(weighs * (sign * ratio - slack), start) for sign, start in self._sides)
        idle = (above == 0) & (below == 0)
        count, rows = len(time), np.arange(len(time))[:, None]
        # each joint's latest row before which both sums were 0; none where they have not been since before
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
        """Joints whose torque has drifted from what was trained on by more than the version's uncertainty allows."""
        return tuple(int(joint) for joint in np.flatnonzero(self.level > OPTIONS.bound))

    @property
    def level(self) -> Array:
        """The larger of both sums, (n,), which is to stay below the bound."""
        return np.maximum(self.above, self.below)

    @property
    def drift(self) -> Array:
        """Mean standardised error since each joint's began, (n,), beyond what was accepted."""
        return np.divide(self.total, self.rows, out=np.zeros_like(self.total), where=self.rows > 0)

    @property
    def began(self) -> float:
        """Event time from which on the alarmed joints have drifted, s."""
        return float(self.since[list(self.joints)].min())

    def evidence(self, joint_names: Sequence[str]) -> dict[str, Any]:
        """What speaks for it, for JSON: the version that was departed from, and per alarmed joint the mean error in its
        stated standard deviations."""
        drift = {joint_names[joint]: float(self.drift[joint]) for joint in self.joints}
        return {"cause": "drift against the trained version", "trained": {"version": self.version, "drift": drift}}

    def decided(self) -> Departure:
        """The same after a change was decided about: where it is the departure itself, what it drifted to is where it
        may be from now on; after any other the robot is not the one that was trained on."""
        if not self.joints:
            return replace(self, retired=True)
        fresh = Departure.start(self.version, len(self.centre))
        return replace(fresh, centre=self.centre + np.where(self.level > OPTIONS.bound, self.drift, 0.0))

    def to_json(self) -> dict[str, Any]:
        """All fields as numbers and lists; `from_json` gives back the same to the last bit."""
        return {"version": self.version, "retired": self.retired} | {
            name: getattr(self, name).tolist() for name in NUMBERS
        }

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> Departure:
        """What `to_json` wrote."""
        numbers = (np.array(values[name], np.float64) for name in NUMBERS)
        return Departure(int(values["version"]), bool(values["retired"]), *numbers)


NUMBERS = ("above", "below", "total", "rows", "since", "centre")


def _reflected(steps: Array, start: Array) -> Array:
    """S after each of N steps, (N, n), with S ← max(0, S + step) from `start`, (n,), on: x + max(start, max −x)."""
    walked = np.cumsum(steps, axis=0)
    return walked + np.maximum(start, np.maximum.accumulate(-walked, axis=0))

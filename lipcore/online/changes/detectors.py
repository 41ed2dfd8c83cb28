"""Detect from prequential records that a robot has changed, and give the evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import Any, Literal

import numpy as np

from lipcore.data.samples import Array
from lipcore.online.record import Record, number

Kind = Literal["sudden", "drift", "departure"]


@dataclass(frozen=True)
class DetectorOptions:
    """Lengths of buckets and windows, and bounds of sudden changes and drift."""

    bucket_s: float = 0.5
    bucket_rows: int = 50
    """Min duration and rows of a bucket. The mean of 50 squared standard normals deviates by 0.2 from 1."""
    recent_s: float = 2.0
    recent_buckets: int = 2
    reference_s: float = 20.0
    min_reference_s: float = 10.0
    min_reference_rows: int = 200
    ratio: float = 4.0
    """Bound on the mean squared error over the earlier one and over the stated one. 30 standard errors of the mean
    of 200 independent rows."""
    deviations: float = 5.0
    """Bound on the bucket means, mapped to a Gaussian by their tail probability. By chance, one in 3 million exceeds it
    if `ratio` is too low."""
    prior_variation: float = 0.5
    prior_buckets: int = 10
    """Assumed variation of the buckets' means, and the number of buckets that it counts for."""
    share: float = 0.75
    """Min share of the recent buckets that exceed the bound: 3 of 4, since a collision of 0.5 s affects 2."""
    allowance: float = float(np.log(2.0))
    """Drift that is ignored: squared errors up to twice those of the best two minutes."""
    max_ratio: float = 8.0
    """Max ratio of a bucket, so that no single one changes the sum by more than log 4 = 1.4."""
    drift_bound: float = 10.0
    """Eight buckets of the max step. On independent rows the sum stays far below it (a step is −0.7 ± 0.2)."""
    first_epoch_s: float = 20.0
    epoch_s: float = 120.0
    max_bucket_s: float = 10.0
    """A longer bucket contains a pause, of which only so much counts as time observed."""


OPTIONS = DetectorOptions()
FRICTION_SHARE = 0.6
"""Min share that suggests friction. Measured over 10 s (three simulated arms, three speeds, noise 0.05 N·m): new
friction explains 0.98 or more of the median joint, a payload 0.03 to 0.5. Over 4 s a tenth of the slow motions do not
reverse a joint, whose friction then looks like a weight (0.5)."""


@dataclass(frozen=True, eq=False)
class Bucket:
    """Record of the rows with start < event time ≤ end, s."""

    start: float
    end: float
    record: Record


@dataclass(frozen=True, eq=False)
class Change:
    """A change of the robot: errors have grown."""

    at: float
    """Event time since which errors have grown, s."""
    joints: tuple[int, ...]
    """The joints affected."""
    before: Record
    """Record of the time before; `after` is that of the time since."""
    after: Record
    kind: Kind
    """`sudden`: within seconds (a payload, a tool). `drift`: over longer (friction, wear, temperature). `departure`:
    errors have not grown, but the model has left the trained version (`lipcore.online.changes.departure`)."""

    def evidence(self, joint_names: Sequence[str], friction: Array | None = None) -> dict[str, Any]:
        """Return the evidence of the change for JSON.

        friction: `friction_share` of the innovations after it, which is added.

        Per joint: nmse, rmse (N·m), standardised (mean of e²/s², 1 if intervals are right) and innovation (mean of e,
        N·m), each before and after; None if unknown.
        """
        figures = [
            (name, getattr(self.before, field), getattr(self.after, field))
            for name, field in (
                ("nmse", "nmse"),
                ("rmse", "rmse"),
                ("standardised", "standardised"),
                ("innovation", "error"),
            )
        ]
        joints: dict[str, dict[str, Any]] = {
            joint: {name: {"before": number(old[j]), "after": number(new[j])} for name, old, new in figures}
            for j, joint in enumerate(joint_names)
        }
        evidence: dict[str, Any] = {
            "kind": self.kind,
            "at": self.at,
            "joints": [joint_names[j] for j in self.joints],
            "rows": {"before": self.before.rows, "after": self.after.rows},
            "per_joint": joints,
        }
        if friction is not None:
            for joint, share in zip(joint_names, friction, strict=True):
                joints[joint]["friction_share"] = number(share)
            evidence["suspect"] = suspect(friction, self.joints)
        return evidence


@dataclass(frozen=True, eq=False)
class ChangeDetector:
    """Detector that compares the errors of the last seconds with earlier ones: immutable, of bounded size, per model.

    Records of rows that passed the gates are summed in buckets of at least 0.5 s and 50 rows, by event time. With z²
    the record's `standardised` of a joint, and ref = max(1, z² of the 20 s before the last 2 s, at least 10 s):

    - sudden: z² of the last 2 s (at least 2 buckets) exceeds r · ref, as a whole and in three of four of its buckets.
      This takes 1 to 2 s if 50 rows take no longer than 0.5 s. r is 4, or more if errors are not independent from row
      to row. Let c² be the squared coefficient of variation of the earlier buckets' z², as of χ² with 2/c² degrees of
      freedom. By Wilson and Hilferty, z² exceeds r = (1 − c²/9 + 5 c/3)³ once in 3 million. Independent rows have c² =
      2/rows. A model outside its training range has 1 to 7; a fixed r of 4 gave ten false alarms in four minutes there.
    - drift: a CUSUM of (log(z² of each bucket / max(1, z² of the best two minutes so far)) − log 2) / (1 + c²)² exceeds
      10. On independent rows, squared errors of 3 times their level are found after 34 buckets, of 8 times after 10.
      The divisor, chosen by measurement, keeps errors that persist for seconds from adding up like independent ones.

    A ref of less than 1 counts as 1: errors that were smaller than stated may grow to the stated size. Buckets and not
    the clock delimit the windows, so that a pause, in which a tool may have been changed, is bridged. After an alarm no
    other is raised until `acknowledged`.
    """

    buckets: tuple[Bucket, ...] = ()
    open: Bucket | None = None
    excess: Array | None = None
    since: Array | None = None
    best: Record | None = None
    epoch: Record | None = None
    epoch_s: float = 0.0
    alarm: Change | None = None

    def step(self, record: Record, at: float) -> tuple[ChangeDetector, Change | None]:
        """Add a record with its last row at event time `at`, s; return the detector and the change that it detects.

        Records of up to about 0.5 s are merged into buckets; longer ones are one bucket each. A late record counts as
        of now. Raise ValueError if the joints differ from those before.
        """
        if not record.rows:
            return self, None
        last = self.open.end if self.open else self.buckets[-1].end if self.buckets else at
        current = Bucket(last, max(at, last), record)
        if self.open:
            current = Bucket(self.open.start, current.end, self.open.record + record)
        if current.record.rows < OPTIONS.bucket_rows or current.end - current.start < OPTIONS.bucket_s * (1 - 1e-6):
            return replace(self, open=current), None
        max_buckets = round((OPTIONS.recent_s + OPTIONS.reference_s) / OPTIONS.bucket_s)
        buckets = (*self.buckets, current)[-max_buckets:]
        if self.alarm:
            return replace(self, open=None, buckets=buckets), None
        following = replace(self, open=None, buckets=buckets)._accumulate(current)
        change = following._sudden() or following._drift()
        return replace(following, alarm=change), change

    def moved(self, seconds: float) -> ChangeDetector:
        """Return the detector with all its times later by so much."""

        def later(bucket: Bucket) -> Bucket:
            return Bucket(bucket.start + seconds, bucket.end + seconds, bucket.record)

        return replace(
            self,
            buckets=tuple(later(each) for each in self.buckets),
            open=None if self.open is None else later(self.open),
            since=None if self.since is None else self.since + seconds,
            alarm=None if self.alarm is None else replace(self.alarm, at=self.alarm.at + seconds),
        )

    def acknowledged(self) -> ChangeDetector:
        """Return the detector with the records since the last alarm as its new reference."""
        if not self.alarm:
            return self
        return ChangeDetector(tuple(b for b in self.buckets if b.start >= self.alarm.at), self.open)

    def _accumulate(self, bucket: Bucket) -> ChangeDetector:
        """Add the log-ratio of one more bucket and store the best epoch."""
        n = bucket.record.n_joints
        excess = np.zeros(n) if self.excess is None else self.excess
        since = np.full(n, bucket.start) if self.since is None else self.since
        if self.best is not None:
            ratio = bucket.record.standardised / _level(self.best)
            weight = (1 + _variation(self._split()[1])) ** 2
            step = (np.log(np.clip(ratio, 1 / OPTIONS.max_ratio, OPTIONS.max_ratio)) - OPTIONS.allowance) / weight
            since = np.where(excess > 0, since, bucket.start)
            excess = np.maximum(excess + step, 0.0)
        epoch = bucket.record if self.epoch is None else self.epoch + bucket.record
        seconds = self.epoch_s + _observed_seconds(bucket)
        best = self.best
        if (
            seconds >= (OPTIONS.first_epoch_s if best is None else OPTIONS.epoch_s)
            and epoch.rows >= OPTIONS.min_reference_rows
        ):
            if best is None or np.log(_level(epoch)).sum() < np.log(_level(best)).sum():
                best = epoch
            return replace(self, excess=excess, since=since, best=best, epoch=None, epoch_s=0.0)
        return replace(self, excess=excess, since=since, epoch=epoch, epoch_s=seconds)

    def _sudden(self) -> Change | None:
        recent, used = self._split()
        seconds, rows = sum(_observed_seconds(b) for b in used), sum(b.record.rows for b in used)
        if seconds < OPTIONS.min_reference_s * (1 - 1e-6) or rows < OPTIONS.min_reference_rows:
            return None
        variation = _variation(used)
        tail = (1 - variation / 9 + OPTIONS.deviations * np.sqrt(variation) / 3) ** 3
        bound = np.maximum(OPTIONS.ratio, tail) * np.maximum(_mean(used), 1.0)
        exceeding = np.array([bucket.record.standardised > bound for bucket in recent])
        joints = (_mean(recent) > bound) & (exceeding.sum(axis=0) >= np.ceil(OPTIONS.share * len(recent)))
        if not joints.any():
            return None
        first = int(exceeding[:, joints].any(axis=1).argmax())
        return Change(recent[first].start, _places(joints), _sum(used), _sum(recent), "sudden")

    def _drift(self) -> Change | None:
        if (
            self.best is None
            or self.excess is None
            or self.since is None
            or not (self.excess > OPTIONS.drift_bound).any()
        ):
            return None
        joints = self.excess > OPTIONS.drift_bound
        recent, _ = self._split()
        return Change(float(self.since[joints].min()), _places(joints), self.best, _sum(recent), "drift")

    def _split(self) -> tuple[tuple[Bucket, ...], tuple[Bucket, ...]]:
        """Return the recent buckets, and those of the 20 s before them."""
        recent = min(OPTIONS.recent_buckets, len(self.buckets))
        while recent < len(self.buckets) and self.buckets[-1].end - self.buckets[-recent].start < OPTIONS.recent_s * (
            1 - 1e-6
        ):
            recent += 1
        first, seconds = len(self.buckets) - recent, 0.0
        while first and seconds < OPTIONS.reference_s * (1 - 1e-6):
            first -= 1
            seconds += _observed_seconds(self.buckets[first])
        return self.buckets[-recent:], self.buckets[first:-recent]


def friction_share(dq: Array, error: Array) -> Array:
    """Return the share of the variance of each joint's innovations that friction explains: (n,), 0 … 1.

    R² of the least-squares fit of error (N, n) on [dq, sign dq, 1] of the same joint, adjusted for the two slopes. The
    offset explains no variance: a payload's constant weight does not count as friction. 0 if nothing varies or there
    are fewer than 20 rows.
    """
    rows, n = error.shape
    out = np.zeros(n)
    if rows < 20:
        return out
    for j in range(n):
        features = np.column_stack([dq[:, j], np.sign(dq[:, j]), np.ones(rows)])
        total = float(((error[:, j] - error[:, j].mean()) ** 2).sum())
        if np.ptp(error[:, j]) > 0 and total > 0:
            left = error[:, j] - features @ np.linalg.lstsq(features, error[:, j], rcond=None)[0]
            out[j] = 1 - float(left @ left) / total * (rows - 1) / (rows - 3)
    return np.clip(out, 0.0, 1.0)


def suspect(friction: Array, joints: tuple[int, ...]) -> str:
    """Return the likely cause: `friction` if that explains the median alarmed joint, else `payload or contact`."""
    return "friction" if np.median(friction[list(joints)]) > FRICTION_SHARE else "payload or contact"


def _observed_seconds(bucket: Bucket) -> float:
    return min(bucket.end - bucket.start, OPTIONS.max_bucket_s)


def _variation(buckets: Sequence[Bucket]) -> Array:
    """Return the squared coefficient of variation of the buckets' standardised errors: (n,), or () without buckets."""
    means = np.array([bucket.record.standardised for bucket in buckets])
    centre = means.mean(axis=0) if len(means) else np.ones(1)
    seen = means.var(axis=0) / np.where(centre > 0, centre, 1.0) ** 2 if len(means) else np.zeros(1)
    return np.asarray(
        (len(means) * seen + OPTIONS.prior_buckets * OPTIONS.prior_variation) / (len(means) + OPTIONS.prior_buckets)
    )


def _mean(buckets: Sequence[Bucket]) -> Array:
    """Return the standardised errors of all rows of the buckets. It runs twice a second, so it sums nothing else."""
    rows = [bucket.record.rows for bucket in buckets]
    return np.asarray(np.average([bucket.record.standardised for bucket in buckets], axis=0, weights=rows))


def _level(record: Record) -> Array:
    return np.maximum(record.standardised, 1.0)


def _sum(buckets: Sequence[Bucket]) -> Record:
    return reduce(add, (bucket.record for bucket in buckets))


def _places(joints: np.ndarray[Any, np.dtype[np.bool_]]) -> tuple[int, ...]:
    return tuple(int(j) for j in np.flatnonzero(joints))

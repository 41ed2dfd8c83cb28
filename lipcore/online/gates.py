"""Which rows may teach: gates for broken, impossible, saturated and standing rows, for contacts and their end."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lipcore.data.outliers import LARGEST_TORQUE
from lipcore.data.samples import Array
from lipcore.model.external import external
from lipcore.vocabulary import Code

Codes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

MAX_GAP_S = 1.0
"""A longer step of time within a batch is a pause, s."""
STATIONARY_SPEED = 1e-3
"""Speed of all joints, rad/s or m/s, below which a row tells of stiction only."""


@dataclass(frozen=True)
class RowLimits:
    """What a row may hold.

    position: largest |q|, of each joint (n,) or of all; velocity, acceleration: largest |dq|, |ddq| of any joint, SI.
    torque: (n,) largest |tau| of each joint, N·m or N, or None where not known. max_gap_s: a longer step of time
    is a pause, s. stationary_speed: a robot whose every |dq| lies below it stands; 0: never. saturation_share: share of
    its limit from which on a torque is taken for cut off, below the limit since a drive's measured torque wavers about
    it: 0.98 leaves 2 %, four standard deviations of a noise of half a per cent of the limit.
    """

    position: Array | float
    velocity: float
    acceleration: float
    torque: Array | None
    max_gap_s: float = MAX_GAP_S
    stationary_speed: float = STATIONARY_SPEED
    saturation_share: float = 0.98


def check_rows(
    t: Array | None,
    q: Array,
    dq: Array,
    ddq: Array | None,
    tau: Array,
    limits: RowLimits,
    after: float | None = None,
    before: float | None = None,
) -> Codes:
    """Code of each row, (N,) places in CODES: the first that applies, or `learnt`.

    t: (N,) s, or None; q, dq, ddq, tau: (N, n) with ddq None where it is yet to be derived.

    - `non_finite`: a number of the row is not finite.
    - `limit`: a magnitude is above its limit.
    - `time_jump`: of the rows with a finite time between `after` and `before`, all but the longest run of strictly
      increasing times, so that one wrong time, forward or backward, costs its row and no other.
    - `saturation`: a |tau| of at least saturation_share of its limit: the robot did not do what the torque says.
    - `stationary`: every |dq| below stationary_speed: stiction holds any torque within its band.

    after, before: times that the rows must lie strictly between, such as `time_span` of the batch before and of the
    batch after, or the time of arrival with some slack, which stops a leap into the future. Raise ValueError where
    shapes differ.
    """
    _check_shapes(t, q, dq, ddq, tau, limits)
    parts = [array for array in (q, dq, ddq, tau) if array is not None]
    finite = np.all([np.isfinite(array).all(axis=1) for array in parts], axis=0)
    if t is not None:
        finite &= np.isfinite(t)
    # the codes of rows that are not finite are set last; numbers in their place keep comparisons quiet
    q, dq, tau = (np.nan_to_num(array) for array in (q, dq, tau))

    codes = np.full(len(q), Code.LEARNT, dtype=np.uint8)
    codes[(np.abs(dq) < limits.stationary_speed).all(axis=1)] = Code.STATIONARY
    most = np.full(q.shape[1], LARGEST_TORQUE) if limits.torque is None else limits.torque
    if limits.torque is not None:
        saturated = np.abs(tau) >= limits.saturation_share * most
        codes[saturated.any(axis=1)] = Code.SATURATION
    if t is not None:
        codes[_time_jumps(t, after, before)] = Code.TIME_JUMP
    beyond = (np.abs(q) > limits.position) | (np.abs(dq) > limits.velocity) | (np.abs(tau) > most)
    if ddq is not None:
        beyond |= np.abs(np.nan_to_num(ddq)) > limits.acceleration
    codes[beyond.any(axis=1)] = Code.LIMIT
    codes[~finite] = Code.NON_FINITE
    return codes


def time_span(time: Array, code: Codes) -> tuple[float, float] | None:
    """First and last time to be believed of a batch of rows, or None: what its neighbours are to lie before and after.

    Rows coded `time_jump` do not count unless no others have a time: then the clock itself was set, and the next batch
    is to follow the new one. So a wrong time at the end of a batch costs one row, and a clock set back one batch.
    """
    known = np.isfinite(time)
    believed = known & (code != Code.TIME_JUMP)
    times = time[believed] if believed.any() else time[known]
    return (float(times[0]), float(times[-1])) if len(times) else None


def is_contact(tau: Array, mean: Array, std: Array, noise_std: Array, threshold: float) -> Mask:
    """Rows (N,) where |z| of `external` is above the threshold at any joint: tau, mean, std (N, n).

    Without a stream's `scale`, which follows what it measures: a contact would widen its own gate.
    """
    return np.asarray((np.abs(external(tau, mean, std, noise_std).z) > threshold).any(axis=1))


SURELY, ECHOED = 5.0, 1e-9
"""Standard deviations of the noise from which on a torque is surely another one; N·m or N up to which two are one."""


def is_implausible(tau: Array, mean: Array, noise_std: Array, gravity: bool) -> Mask:
    """Rows, (N,) in order of time, whose torque nobody has measured; all of them where most are.

    tau, mean: (N, n), said to be measured, and the model's; noise_std: (n,); gravity: whether torques contain it.

    - Zero at all joints, where gravity makes it surely another one.
    - The model's own at all joints, of this row or of the one before: a command, or an answer, that is sent back.
    - The same at all joints from row to row, while the model's surely becomes another one.
    """
    found = np.zeros(len(tau), np.bool_)
    if not len(tau):
        return found
    if gravity:
        found |= (tau == 0).all(axis=1) & (np.abs(mean) > SURELY * noise_std).any(axis=1)
    found |= (np.abs(tau - mean) < ECHOED).all(axis=1)
    found[1:] |= (np.abs(tau[1:] - mean[:-1]) < ECHOED).all(axis=1)
    run = np.concatenate([[0], np.cumsum((tau[1:] != tau[:-1]).any(axis=1))])  # of rows that are the same
    first = np.searchsorted(run, run)
    stuck = (np.abs(mean - mean[first]) > SURELY * noise_std).any(axis=1)
    found |= np.isin(run, run[stuck])
    return np.ones_like(found) if found.mean() > 0.5 else found


LONGEST_SHARE = 0.1
"""Most of the patience that one step of time uses up: a pause in a stream is not time in contact, and a stream of few
rows a second needs at least ten of them."""


@dataclass(frozen=True)
class Patience:
    """How long torques have been far off: immutable, one per stream, followed in event time.

    It runs from a contact row on for as long as more than half of the rows since are contacts. Once it has run for
    `seconds`, at a row that is a contact itself, `exhausted` is set and stays: this is no contact but a change of the
    robot. A collision ends before; knocks that are further apart than they last start anew each time.
    """

    seconds: float
    exhausted: bool = False
    elapsed: float = 0.0
    rows: int = 0
    contacts: int = 0
    last: float | None = None

    def step(self, time: Array, contact: Mask) -> Patience:
        """Follow rows at event times (N,) s that are contacts or not, (N,); time that goes backwards counts as 0."""
        if self.exhausted or len(time) == 0:
            return self
        if not self.rows and not contact.any():
            return replace(self, last=float(time[-1]))
        elapsed, rows, contacts, last = self.elapsed, self.rows, self.contacts, self.last
        longest = LONGEST_SHARE * self.seconds
        for now, hit in zip(time.tolist(), contact.tolist(), strict=True):
            if rows:
                elapsed += min(max(now - last, 0.0), longest) if last is not None else 0.0
            last = now
            if not rows and not hit:
                continue
            rows, contacts = rows + 1, contacts + hit
            if 2 * contacts <= rows:
                elapsed, rows, contacts = 0.0, 0, 0
            elif hit and elapsed >= self.seconds * (1 - 1e-9):
                return replace(self, exhausted=True, elapsed=elapsed, rows=rows, contacts=contacts, last=last)
        return replace(self, elapsed=elapsed, rows=rows, contacts=contacts, last=last)


CONTACT_PATIENCE_S = 2.0
"""How long torques may be far off before it is no contact but a change of the robot, s."""


@dataclass(frozen=True)
class ContactGate:
    """Rejects rows far outside a stream's predictive interval for as long as that can be a contact; immutable.

    It stands back while a changed robot is learnt anew. patience: how long rows have been contacts. calm: how long they
    have not, while the gate stands back; else None.
    """

    patience: Patience
    calm: Patience | None = None

    @classmethod
    def start(cls, seconds: float = CONTACT_PATIENCE_S) -> ContactGate:
        """A gate that keeps contacts out for so long."""
        return cls(Patience(seconds))

    def to_json(self) -> list[list[Any] | None]:
        """Its state as numbers and lists; `from_json` gives back the same gate to the last bit."""
        return [None if each is None else list(astuple(each)[1:]) for each in (self.patience, self.calm)]

    @classmethod
    def from_json(cls, values: Sequence[Sequence[Any] | None], seconds: float = CONTACT_PATIENCE_S) -> ContactGate:
        """The gate that `to_json` wrote, with the patience of this release, s."""
        patience, calm = (None if each is None else Patience(seconds, *each) for each in values)
        return cls(patience or Patience(seconds), calm)

    @property
    def open(self) -> bool:
        """Whether it stands back: contacts and what has changed cannot be told apart."""
        return self.calm is not None

    @property
    def exhausted(self) -> bool:
        """Whether this has lasted too long for a contact."""
        return self.patience.exhausted

    @property
    def began(self) -> float | None:
        """Event time of the first of the rows that have been contacts for so long, s."""
        return None if self.patience.last is None else self.patience.last - self.patience.elapsed

    def step(self, time: Array, contact: Mask) -> ContactGate:
        """Follow rows at event times (N,) that are contacts or not; a gate that stood back returns once they fit."""
        if self.calm is None:
            return ContactGate(self.patience.step(time, contact))
        calm = self.calm.step(time, ~contact)
        return ContactGate.start(calm.seconds) if calm.exhausted else ContactGate(self.patience, calm)

    def stand_back(self) -> ContactGate:
        """Let everything pass until most rows fit again for as long as the patience lasts."""
        fresh = Patience(self.patience.seconds)
        return ContactGate(fresh, fresh)


def _check_shapes(t: Array | None, q: Array, dq: Array, ddq: Array | None, tau: Array, limits: RowLimits) -> None:
    if q.ndim != 2:
        raise ValueError(f"q has shape {q.shape}, expected (N, n)")
    for name, array in (("dq", dq), ("ddq", ddq), ("tau", tau)):
        if array is not None and array.shape != q.shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {q.shape} as q has")
    if t is not None and t.shape != q.shape[:1]:
        raise ValueError(f"t has shape {t.shape}, expected {q.shape[:1]}")
    if limits.torque is not None and limits.torque.shape != q.shape[1:]:
        raise ValueError(f"limits.torque has shape {limits.torque.shape}, expected {q.shape[1:]}, one limit a joint")


def _time_jumps(t: Array, after: float | None, before: float | None) -> Mask:
    """Rows (N,) whose time is out of bounds or out of order."""
    inside = np.isfinite(t)
    inside &= (t > (-np.inf if after is None else after)) & (t < (np.inf if before is None else before))
    kept = np.flatnonzero(inside)
    if (t[kept[1:]] <= t[kept[:-1]]).any():
        kept = kept[_longest_increasing(t[kept].tolist())]
    jumps = np.ones(len(t), dtype=np.bool_)
    jumps[kept] = False
    return jumps


def _longest_increasing(values: list[float]) -> list[int]:
    """Places of a longest strictly increasing subsequence: of equal values the first, of two ends the lower."""
    ends: list[float] = []
    places: list[int] = []
    previous = [-1] * len(values)
    for index, value in enumerate(values):
        at = bisect_left(ends, value)
        if at < len(ends) and ends[at] == value:
            continue
        previous[index] = places[at - 1] if at else -1
        ends[at : at + 1] = [value]
        places[at : at + 1] = [index]
    chain, index = [], places[-1] if places else -1
    while index >= 0:
        chain.append(index)
        index = previous[index]
    return chain[::-1]

"""Decide which rows are learnt: gates for broken, impossible, saturated and stationary rows, and for contacts."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lipcore.data.outliers import MAX_TORQUE
from lipcore.data.samples import Array
from lipcore.model.external import external
from lipcore.vocabulary import Code

Codes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

MAX_GAP_S = 1.0
"""A longer time step within a batch is a gap in the recording, s."""
STATIONARY_SPEED = 1e-3
"""Speed of all joints, rad/s or m/s, below which a row shows only stiction."""


@dataclass(frozen=True)
class RowLimits:
    """Limits of a valid row, SI units."""

    position: Array | float
    """Max |q|, of each joint (n,) or of all joints."""
    velocity: float
    """Max |dq| of any joint."""
    acceleration: float
    """Max |ddq| of any joint."""
    torque: Array | None
    """Max |tau| of each joint, (n,), or None if unknown."""
    max_gap_s: float = MAX_GAP_S
    """A longer time step is a gap, s."""
    stationary_speed: float = STATIONARY_SPEED
    """The robot is at rest if every |dq| is below this speed; 0: never."""
    saturation_share: float = 0.98
    """Min share of its limit at which a torque counts as saturated. It is below 1 because a drive's measured torque is
    noisy: 0.98 leaves 2 %, four standard deviations of a noise of half a per cent of the limit."""


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
    """Return the code of each row, (N,) places in CODES: the first reason that applies, or `learnt`.

    t: (N,) s, or None; q, dq, ddq, tau: (N, n), with ddq None if it is derived later.

    - `non_finite`: a number of the row is not finite.
    - `limit`: a magnitude exceeds its limit.
    - `time_jump`: of the rows with a finite time between `after` and `before`, all but the longest run of strictly
      increasing times. One wrong time, forward or backward, therefore rejects its own row and no other.
    - `saturation`: a |tau| of at least saturation_share of its limit: the drive may have produced less than reported.
    - `stationary`: every |dq| is below stationary_speed: stiction can balance any torque within its range.

    after, before: times between which the rows must lie, strictly. Examples are `time_span` of the batches before and
    after, or the time of arrival plus a margin, which rejects a jump into the future. Raise ValueError if shapes
    differ.
    """
    _check_shapes(t, q, dq, ddq, tau, limits)
    parts = [array for array in (q, dq, ddq, tau) if array is not None]
    finite = np.all([np.isfinite(array).all(axis=1) for array in parts], axis=0)
    if t is not None:
        finite &= np.isfinite(t)
    # zeros avoid warnings in the comparisons; rows that are not finite get their code last
    q, dq, tau = (np.nan_to_num(array) for array in (q, dq, tau))

    codes = np.full(len(q), Code.LEARNT, dtype=np.uint8)
    codes[(np.abs(dq) < limits.stationary_speed).all(axis=1)] = Code.STATIONARY
    most = np.full(q.shape[1], MAX_TORQUE) if limits.torque is None else limits.torque
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
    """Return the first and last plausible time of a batch, or None; neighbouring batches must lie outside of it.

    Rows coded `time_jump` do not count unless no other row has a time. In that case the clock itself was set, and the
    next batch must follow the new time. A wrong time at the end of a batch therefore costs one row; a clock set back
    costs one batch.
    """
    known = np.isfinite(time)
    believed = known & (code != Code.TIME_JUMP)
    times = time[believed] if believed.any() else time[known]
    return (float(times[0]), float(times[-1])) if len(times) else None


def is_contact(tau: Array, mean: Array, std: Array, noise_std: Array, threshold: float) -> Mask:
    """Return the rows (N,) with |z| (see `external`) above the threshold at any joint. tau, mean, std: (N, n).

    The stream's `scale` is not used: it follows the measurements, so a contact would widen its own gate.
    """
    return np.asarray((np.abs(external(tau, mean, std, noise_std).z) > threshold).any(axis=1))


MIN_DISTINCT_STDS, MAX_ECHO_DIFFERENCE = 5.0, 1e-9
"""Min difference of two distinct torques, in standard deviations of the noise; max difference of two equal torques, N·m
or N."""


def is_implausible(tau: Array, mean: Array, noise_std: Array, gravity: bool) -> Mask:
    """Return the rows, (N,) in order of time, with torque that cannot be measured; all if more than half are such.

    tau, mean: (N, n), the torque sent as measured, and the model's; noise_std: (n,); gravity: whether torques contain
    it.

    - Zero at all joints, although gravity requires a distinct torque.
    - The model's torque at all joints, of this row or of the one before: a command or a prediction that was sent back.
    - Unchanged at all joints from row to row, while the model's torque becomes a distinct one.
    """
    found = np.zeros(len(tau), np.bool_)
    if not len(tau):
        return found
    if gravity:
        found |= (tau == 0).all(axis=1) & (np.abs(mean) > MIN_DISTINCT_STDS * noise_std).any(axis=1)
    found |= (np.abs(tau - mean) < MAX_ECHO_DIFFERENCE).all(axis=1)
    found[1:] |= (np.abs(tau[1:] - mean[:-1]) < MAX_ECHO_DIFFERENCE).all(axis=1)
    run = np.concatenate([[0], np.cumsum((tau[1:] != tau[:-1]).any(axis=1))])  # number of the run of equal rows
    first = np.searchsorted(run, run)
    stuck = (np.abs(mean - mean[first]) > MIN_DISTINCT_STDS * noise_std).any(axis=1)
    found |= np.isin(run, run[stuck])
    return np.ones_like(found) if found.mean() > 0.5 else found


MAX_STEP_SHARE = 0.1
"""Max share of the patience that one time step uses up. A pause in a stream is not time in contact, and a stream of few
rows a second needs at least ten of them."""


@dataclass(frozen=True)
class Patience:
    """Time for which torques have been far off; immutable, one per stream, in event time.

    The time runs from a contact row on while more than half of the rows since are contacts. `exhausted` is set at a
    contact row once `seconds` have passed, and stays set: the robot has changed. A collision ends earlier. Knocks that
    are further apart than they last restart the time.
    """

    seconds: float
    exhausted: bool = False
    elapsed: float = 0.0
    rows: int = 0
    contacts: int = 0
    last: float | None = None

    def step(self, time: Array, contact: Mask) -> Patience:
        """Add rows at event times (N,), s; contact: (N,). Time that goes backwards counts as 0."""
        if self.exhausted or len(time) == 0:
            return self
        if not self.rows and not contact.any():
            return replace(self, last=float(time[-1]))
        elapsed, rows, contacts, last = self.elapsed, self.rows, self.contacts, self.last
        longest = MAX_STEP_SHARE * self.seconds
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
"""Max duration of a contact, s. If torques are far off for longer, the robot has changed."""


@dataclass(frozen=True)
class ContactGate:
    """Gate that rejects rows far outside a stream's interval while that can be a contact; immutable.

    The gate is open while a changed robot is learnt again: it lets contacts through.
    """

    patience: Patience
    """How long rows have been contacts."""
    calm: Patience | None = None
    """How long they have not, while the gate is open; else None."""

    @classmethod
    def start(cls, seconds: float = CONTACT_PATIENCE_S) -> ContactGate:
        """Return a closed gate that rejects contacts of up to `seconds`."""
        return cls(Patience(seconds))

    def to_json(self) -> list[list[Any] | None]:
        """Return the state as numbers and lists; `from_json` restores it to the last bit."""
        return [None if each is None else list(astuple(each)[1:]) for each in (self.patience, self.calm)]

    @classmethod
    def from_json(cls, values: Sequence[Sequence[Any] | None], seconds: float = CONTACT_PATIENCE_S) -> ContactGate:
        """Return the gate that `to_json` wrote, with the patience of this release, s."""
        patience, calm = (None if each is None else Patience(seconds, *each) for each in values)
        return cls(patience or Patience(seconds), calm)

    @property
    def is_open(self) -> bool:
        """Whether the gate lets contacts through, because contacts and the change cannot be told apart."""
        return self.calm is not None

    @property
    def exhausted(self) -> bool:
        """Whether rows have been contacts for too long for a contact."""
        return self.patience.exhausted

    @property
    def began(self) -> float | None:
        """Event time of the first row of these contacts, s."""
        return None if self.patience.last is None else self.patience.last - self.patience.elapsed

    def step(self, time: Array, contact: Mask) -> ContactGate:
        """Add rows at event times (N,) that are contacts or not. An open gate closes once most rows fit."""
        if self.calm is None:
            return ContactGate(self.patience.step(time, contact))
        calm = self.calm.step(time, ~contact)
        return ContactGate.start(calm.seconds) if calm.exhausted else ContactGate(self.patience, calm)

    def let_all_pass(self) -> ContactGate:
        """Open the gate until most rows have fitted for as long as the patience lasts."""
        fresh = Patience(self.patience.seconds)
        return ContactGate(fresh, fresh)


def _check_shapes(t: Array | None, q: Array, dq: Array, ddq: Array | None, tau: Array, limits: RowLimits) -> None:
    if q.ndim != 2:
        raise ValueError(f"q has shape {q.shape}, expected (N, n)")
    for name, array in (("dq", dq), ("ddq", ddq), ("tau", tau)):
        if array is not None and array.shape != q.shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {q.shape}, the shape of q")
    if t is not None and t.shape != q.shape[:1]:
        raise ValueError(f"t has shape {t.shape}, expected {q.shape[:1]}")
    if limits.torque is not None and limits.torque.shape != q.shape[1:]:
        raise ValueError(f"limits.torque has shape {limits.torque.shape}, expected {q.shape[1:]}, one limit a joint")


def _time_jumps(t: Array, after: float | None, before: float | None) -> Mask:
    """Return the rows (N,) with times out of bounds or out of order."""
    inside = np.isfinite(t)
    inside &= (t > (-np.inf if after is None else after)) & (t < (np.inf if before is None else before))
    kept = np.flatnonzero(inside)
    if (t[kept[1:]] <= t[kept[:-1]]).any():
        kept = kept[_longest_increasing(t[kept].tolist())]
    jumps = np.ones(len(t), dtype=np.bool_)
    jumps[kept] = False
    return jumps


def _longest_increasing(values: list[float]) -> list[int]:
    """Return places of a longest strictly increasing subsequence: of equal values the first, of ends the lower."""
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

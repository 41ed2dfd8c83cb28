"""Rows recorded with closed brakes: the arm stands still, and a torque reads zero instead of what gravity requires.

A torque computed from motor current is zero when the drive is off, because the brake holds the joint. Beside such a
stretch, in the same posture, the drive needs another torque. There, a joint without gravity, as about a vertical axis,
needs only friction and inertia, which change their sign with the direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lipcore.data.outliers import ColumnReader, Mask
from lipcore.data.samples import Array, Samples


@dataclass(frozen=True)
class BrakeOptions:
    """Limits of a stretch with closed brakes.

    Tuned on 1440 simulated recordings of 20 arms with moves and rests, friction and `Dirt`: none without brakes is
    reported. None of eight real arms is either.
    """

    min_s: float = 0.3
    """Min duration, s."""
    still_rad: float = 1e-3
    still_s: float = 0.1
    """A joint stands still if it moves less than this, rad or m, within this time, s."""
    max_zero: float = 0.05
    max_mean: float = 0.01
    """Max |tau| of a row, and of the mean of a stretch, as shares of the joint's usual torque in motion."""
    min_usual: float = 0.02
    """Min usual torque, as a share of the largest: a joint without load has only noise."""
    beside_s: float = 0.05
    """Time on either side in which the torque beside a stretch is read, and max time step, s."""
    min_moved: float = 1e-4
    """Way in this time, rad or m, below which inertia needs no torque."""
    min_load: float = 0.15
    """Min |tau| beside a stretch without friction and inertia, as a share of the usual torque. It also exceeds both."""
    min_share: float = 0.5
    """Min share of a joint's stretches with such a load."""
    min_stretches: int = 2
    """Min stretches of all joints together: one alone may be a posture in balance."""


OPTIONS = BrakeOptions()


@dataclass(frozen=True)
class BrakedRows:
    """Rows with closed brakes. rows: (N,) mask; joints: those with zero torque there."""

    rows: Mask
    joints: tuple[int, ...] = ()

    @property
    def stretches(self) -> list[tuple[int, int]]:
        """Return the first and last row of each contiguous stretch, counted from 0."""
        return _runs(self.rows, np.ones(max(0, len(self.rows) - 1), np.bool_))


def find_braked_rows(t: Array | None, episode: NDArray[np.number], n_joints: int, read: ColumnReader) -> BrakedRows:
    """Return the rows of a recording with closed brakes; none without times, or if rows are not in their order.

    t: (N,) s; episode: (N,), equal over one contiguous recording; read: returns a column of q or tau, NaN if missing.
    """
    nothing = BrakedRows(np.zeros(len(episode), np.bool_))
    steps = np.zeros(0) if t is None else np.diff(t)
    period = float(np.median(steps[steps > 0])) if (steps > 0).any() else np.inf
    if t is None or period > OPTIONS.beside_s:
        return nothing
    follows = (np.diff(episode) == 0) & (steps > 0) & (steps < OPTIONS.min_s)
    still = _standstill([read("q", joint) for joint in range(n_joints)], max(1, round(OPTIONS.still_s / period)))
    moving = [tau[~still & np.isfinite(tau)] for tau in (read("tau", joint) for joint in range(n_joints))]
    sizes = [float(np.sqrt(np.mean(tau**2))) if len(tau) else 0.0 for tau in moving]
    loaded, zero = np.zeros_like(still), np.ones_like(still)
    joints, count = [], 0
    for joint, size in enumerate(sizes):
        usual = max(size, OPTIONS.min_usual * max(sizes))
        tau = read("tau", joint)
        runs = _runs(still & (np.abs(tau) < OPTIONS.max_zero * usual), follows)
        runs = [(a, b) for a, b in runs if t[b] - t[a] >= OPTIONS.min_s]
        runs = [(a, b) for a, b in runs if abs(tau[a : b + 1].mean()) < OPTIONS.max_mean * usual]
        beside = max(1, round(OPTIONS.beside_s / period))
        chosen = _loaded(runs, read("q", joint), tau, follows, beside, usual)
        if runs and chosen.mean() >= OPTIONS.min_share:
            joints.append(joint)
            count += int(chosen.sum())
            loaded |= _rows([run for run, yes in zip(runs, chosen, strict=True) if yes], len(t))
            zero &= _rows(runs, len(t))
    # a stretch counts if one joint carries a load beside it, or if no joint has torque in it
    return BrakedRows(loaded | zero, tuple(joints)) if count >= OPTIONS.min_stretches else nothing


def find_in_samples(samples: Samples) -> BrakedRows:
    """Return the rows of samples with closed brakes."""
    return find_braked_rows(
        samples.t, samples.episode, samples.n_joints, lambda name, joint: np.asarray(getattr(samples, name)[:, joint])
    )


def _standstill(positions: list[Array], apart: int) -> Mask:
    """Return the rows (N,) in which no joint moves until, or since, the row `apart` rows away. positions: (N,) each."""
    still = np.zeros(len(positions[0]), np.bool_)
    quiet = np.all([np.abs(q[apart:] - q[:-apart]) < OPTIONS.still_rad for q in positions], axis=0)
    still[apart:] |= quiet
    still[: len(quiet)] |= quiet
    return still


def _runs(mask: Mask, follows: Mask) -> list[tuple[int, int]]:
    """Return first and last row of each run of a mask (N,). follows: whether the next row belongs to it, (N - 1,)."""
    joined = mask[1:] & mask[:-1] & follows
    starts, ends = mask & ~np.append(False, joined)[: len(mask)], mask & ~np.append(joined, False)[: len(mask)]
    return list(zip(np.flatnonzero(starts).tolist(), np.flatnonzero(ends).tolist(), strict=True))


def _rows(runs: list[tuple[int, int]], count: int) -> Mask:
    """Return the mask of runs, (count,)."""
    mask = np.zeros(count, np.bool_)
    for first, last in runs:
        mask[first : last + 1] = True
    return mask


def _loaded(runs: list[tuple[int, int]], q: Array, tau: Array, follows: Mask, beside: int, usual: float) -> Mask:
    """Return the runs of zero torque, (R,), beside which a joint carries a load. q, tau: (N,)."""
    level, moved = np.full((2, len(runs), 2), np.nan)
    for run, (a, b) in enumerate(runs):
        for side, first, last in ((0, a - beside, a), (1, b, b + beside)):
            if first >= 0 and last < len(q) and follows[first:last].all():
                level[run, side] = tau[first + side : last + side].mean()
                moved[run, side] = q[last] - q[first]
    known = np.isfinite(level) & np.isfinite(moved)
    # friction, and inertia: from rest or to rest, the way is proportional to the acceleration
    design = np.stack([np.sign(moved), moved * [-1.0, 1.0]], axis=-1)
    design[np.abs(moved) < OPTIONS.min_moved, 1] = 0.0
    factors = np.linalg.lstsq(design[known], level[known], rcond=None)[0]
    load = level - design @ factors
    loaded = np.abs(load) > np.maximum(OPTIONS.min_load * usual, np.abs(design * factors).sum(axis=-1))
    same = np.where(known, np.sign(load), 0.0).prod(axis=1) >= 0
    return np.asarray(known.any(axis=1) & (loaded | ~known).all(axis=1) & same)

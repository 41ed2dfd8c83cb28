"""Repetition of motion: instants that have a similar state at another time.

Metrics of a held-out part that repeats the training are too good: a model that only remembers predicts it well.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from lipcore.data.motion import spaced_rows
from lipcore.data.samples import Array, Samples
from lipcore.data.splits import Mask, Numbers


@dataclass(frozen=True)
class RepetitionOptions:
    """Limits within which two instants are similar, and a stretch repeats another."""

    max_near: float = 0.25
    min_near: float = 0.1
    """Two instants are similar if their distance is below half the step to the next instant. This limit is kept between
    these shares of the usual distance of two instants."""
    repeated_share: float = 0.5
    """A stretch repeats if at least this share of its instants has a similar instant elsewhere in time."""
    block_instants: int = 60
    """Max instants of a block that are compared."""
    part_instants: int = 600
    """Max instants of a part that are compared."""
    min_spread: tuple[float, float, float] = (0.01, 0.02, 0.1)
    """Min spreads of position, velocity and acceleration that count as motion: rad, rad/s and rad/s² (m, m/s, m/s²)."""


OPTIONS = RepetitionOptions()


def features(samples: Samples, joint_types: Sequence[str]) -> Array:
    """Return the states of a robot at N instants, (N, k), each divided by its spread.

    A state is cos q and sin q (of prismatic joints q), dq and ddq. joint_types: (n,).
    """
    turns = np.array([each == "revolute" for each in joint_types])
    parts = []
    for angle, least in zip((samples.q, samples.dq, samples.ddq), OPTIONS.min_spread, strict=True):
        columns = angle[:, None, :]
        if angle is samples.q:
            columns = np.stack([np.where(turns, np.cos(angle), angle), np.where(turns, np.sin(angle), 0.0)], axis=1)
        spread = np.sqrt(columns.var(axis=0).sum(axis=0))
        parts.append((columns / np.maximum(spread, least)).reshape(len(angle), -1))
    return np.concatenate(parts, axis=1)


def measure_repeated_shares(states: Array, edges: Numbers) -> Array:
    """Return the share of the instants of each of B blocks with a similar instant elsewhere in time, (B,).

    states: (N, k), in order of time; edges: (B + 1,), where blocks begin and end. Elsewhere is neither the block nor
    those beside it, because a motion leaves and enters a block slowly.
    """
    shares = np.zeros(len(edges) - 1)
    for block, like in enumerate(_likes(states, edges)):
        elsewhere = np.delete(like, slice(max(block - 1, 0), block + 2), axis=1)
        shares[block] = elsewhere.any(axis=1).mean() if elsewhere.size else 0.0
    return shares


def group_blocks(states: Array, edges: Numbers) -> Numbers:
    """Return the number of the group of each of B blocks, (B,).

    Blocks repeat, directly or through others, blocks of their group and no other.
    Arguments as of `measure_repeated_shares`.
    """
    # these imports take as long as the rest of the module
    from scipy.sparse import csr_array  # noqa: PLC0415
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    linked = np.array([like.mean(axis=0) >= OPTIONS.repeated_share for like in _likes(states, edges)])
    return np.asarray(connected_components(csr_array(linked), directed=False)[1], np.int64)


def nearest(states: Array, edges: Numbers) -> Iterator[tuple[Numbers, Array]]:
    """Yield, block by block, some of its instants and their distances from the nearest instant of each block.

    states: (N, k), in order of time; edges: (B + 1,), where blocks begin and end. Yields rows (R,), distances (R, B).
    """
    for first, last in pairwise(edges.tolist()):
        rows = spaced_rows(last - first, OPTIONS.block_instants, first)
        yield rows, np.sqrt(np.minimum.reduceat(_squares(states[rows], states), edges[:-1], axis=1))


class Repetition(NamedTuple):
    """How much of a part repeats motion of the training."""

    share: float
    """Share of the part's instants with a similar instant in the training."""
    period: float | None
    """Period of the training's motion, s, None if it has none."""

    @property
    def is_repeated(self) -> bool:
        """Return whether the part repeats the training."""
        return self.share >= OPTIONS.repeated_share


def repetition(training: Samples, part: Samples, joint_types: Sequence[str]) -> Repetition:
    """Return how much of a part repeats motion of the training.

    training, part: at least one row each, the training in order of time within its episodes; joint_types: (n,).
    """
    states = features(Samples.concatenate([training, part]), joint_types)
    share = measure_repeated_share(states[: len(training)], states[len(training) :])
    return Repetition(share, find_period(training, joint_types))


def measure_repeated_share(known: Array, states: Array) -> float:
    """Return the share of states (R, k) that have a similar state among the known states (N, k), in order of time."""
    limits, shares = _limits(known, np.concatenate([known, states])), []
    rows = spaced_rows(len(states), OPTIONS.part_instants)
    for few in np.array_split(rows, max(1, len(rows) // 100)):
        squares = _squares(states[few], known)
        nearest = squares.argmin(axis=1)
        shares.append(np.sqrt(squares[np.arange(len(few)), nearest]) <= limits[nearest])
    return float(np.concatenate(shares).mean())


def measure_distinct_share(samples: Samples, joint_types: Sequence[str]) -> float:
    """Return the share of a recording that remains if repeated motion counts once, from 0 to 1.

    samples: at least one row, in order of time within its episodes; joint_types: (n,). An instant that the recording
    passes k times counts 1 / k. Two passes are separate if, between them, the distance exceeds twice the limit of
    similarity.
    """
    states = features(samples, joint_types)
    limits, passes = _limits(states, states), []
    for row in spaced_rows(len(states), OPTIONS.part_instants):
        distances = np.sqrt(_squares(states[row : row + 1], states)[0])
        near, left = distances <= limits[row], distances > 2 * limits[row]
        inside = near[near | left]
        passes.append(inside[0] + np.count_nonzero(inside[1:] & ~inside[:-1]))
    return float(np.mean(1 / np.array(passes)))


def find_period(samples: Samples, joint_types: Sequence[str]) -> float | None:
    """Return the time after which a motion repeats itself, s; None if there is no single such time.

    It is the median, over instants, of the time until the motion returns to the state. Before that, its distance must
    exceed twice the limit of similarity. At least a quarter of the instants must return, and 60 % of these within 5 %
    of that time. Tuned on simulated arms (`tests/lipcore/data/test_repetition.py`).
    """
    states = features(samples, joint_types)
    limits, lags, asked = _limits(states, states), [], 0
    ends = np.concatenate([np.flatnonzero(np.diff(samples.episode)) + 1, [len(samples)]])
    for row in spaced_rows(len(samples), OPTIONS.part_instants // 2):
        asked += 1
        end = ends[np.searchsorted(ends, row, side="right")]
        distances = np.sqrt(_squares(states[row : row + 1], states[row:end])[0])
        again = _return(distances, limits[row])
        if again is not None:
            lags.append(samples.t[row + again] - samples.t[row])
    if len(lags) < max(1, 0.25 * asked):
        return None
    usual = float(np.median(lags))
    return usual if np.mean(np.abs(np.array(lags) - usual) <= 0.05 * usual) >= 0.6 else None


def _return(distances: Array, limit: float) -> int | None:
    """Return the index at which a motion is nearest to its start when it first returns; None if it does not."""
    left = np.flatnonzero(distances > 2 * limit)
    back = np.flatnonzero(distances[left[0] :] <= limit) + left[0] if len(left) else left
    if not len(back):
        return None
    gone = np.flatnonzero(distances[back[0] :] > limit)
    end = back[0] + gone[0] if len(gone) else len(distances)
    return int(back[0] + distances[back[0] : end].argmin())


def _likes(states: Array, edges: Numbers) -> Iterator[Mask]:
    """Yield, for each of B blocks, which of its compared instants have a like instant in which block: (R, B)."""
    limits = _limits(states, states)
    for rows, distances in nearest(states, edges):
        yield distances <= limits[rows, None]


def _limits(states: Array, all_states: Array) -> Array:
    """Return the distance below which another instant is like each of these, (N,)."""
    usual = np.sqrt(2 * all_states.var(axis=0).sum())
    steps = np.linalg.norm(np.diff(states, axis=0, append=states[-2:-1]), axis=1) if len(states) > 1 else np.zeros(1)
    return np.asarray(np.clip(0.5 * steps, OPTIONS.min_near * usual, OPTIONS.max_near * usual))


def _squares(states: Array, others: Array) -> Array:
    """Return squared distances, (R, N)."""
    products = states @ others.T
    squares = np.square(states).sum(axis=1)[:, None] - 2 * products + np.square(others).sum(axis=1)
    return np.asarray(np.maximum(squares, 0.0))

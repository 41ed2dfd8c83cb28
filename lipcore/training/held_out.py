"""What to judge estimators on: blocks of a recording whose motion the rest of it does not repeat.

A held-out block that repeats motion of the training flatters: it is predicted well by what has only been remembered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array, Samples
from lipcore.data.splits import GUARD_S, Mask, Numbers, Parts, SplitError, guarded

LEAST_ROWS, LEAST_BLOCKS, MOST_BLOCKS = 60, 4, 20
"""Fewest rows that some are held out of, and how many blocks a recording is divided into."""
BLOCK_ROWS, BLOCK_S = 15, 4 * GUARD_S
"""Rows and seconds that a block has at least."""
SHARE = 0.25
"""Of the blocks, held out."""
NEAR, NEAREST = 0.25, 0.1
"""Two instants are alike where they lie nearer to each other than half a step from one instant to the next, but nearer
than the first share of the usual distance of two instants, and no nearer than the second need be."""
REPEATED = 0.5
"""Share of a block's instants that have their like elsewhere in time, from which on it repeats."""
ASKED = 60
"""Instants of a block that are looked at."""
LEAST_SPREAD = (0.01, 0.02, 0.1)
"""Smallest spreads of position, velocity and acceleration that count as motion: rad, rad/s and rad/s² (m)."""


@dataclass(frozen=True)
class Unseen:
    """Which rows to train on and which to judge by (`parts`).

    blocks: how many are held out; repeats: every block of the recording repeats others, so that those held out do, too.
    """

    parts: Parts
    blocks: int
    repeats: bool


def hold_out(samples: Samples, joint_types: Sequence[str]) -> Unseen:
    """Hold about a quarter of the samples out, in blocks from all over the recording.

    Raise SplitError where there is too little to hold any out.
    """
    if len(samples) < LEAST_ROWS:
        raise SplitError("rows", len(samples), f"at least {LEAST_ROWS} to hold some out")
    order = np.lexsort((samples.t, samples.episode))
    lasts = float(np.maximum(np.diff(samples.t[order]), 0.0).sum())
    count = int(min(MOST_BLOCKS, len(samples) // BLOCK_ROWS, lasts // BLOCK_S))
    if count < LEAST_BLOCKS:
        raise SplitError("seconds", round(lasts, 3), f"at least {LEAST_BLOCKS * BLOCK_S:g} to hold some out")
    edges = np.linspace(0, len(samples), count + 1).round().astype(np.int64)
    number = max(1, round(SHARE * count))
    new = np.flatnonzero(repeated(features(samples.rows(order), joint_types), edges) < REPEATED)
    repeats = len(new) < max(1, number // 2)
    candidates = np.arange(count) if repeats else new
    number = min(number, len(candidates))
    chosen = candidates[((np.arange(number) + 0.5) * len(candidates) / number).astype(np.int64)]
    held: Mask = np.isin(np.repeat(np.arange(count), np.diff(edges)), chosen)
    return Unseen(guarded(samples.episode, samples.t, order, held, GUARD_S), number, repeats)


def features(samples: Samples, joint_types: Sequence[str]) -> Array:
    """The state of a robot at N instants, (N, k): cos q and sin q, of sliding joints q, dq and ddq, by their spread.

    joint_types: (n,).
    """
    turns = np.array([each == "revolute" for each in joint_types])
    parts = []
    for angle, least in zip((samples.q, samples.dq, samples.ddq), LEAST_SPREAD, strict=True):
        columns = angle[:, None, :]
        if angle is samples.q:
            columns = np.stack([np.where(turns, np.cos(angle), angle), np.where(turns, np.sin(angle), 0.0)], axis=1)
        spread = np.sqrt(columns.var(axis=0).sum(axis=0))
        parts.append((columns / np.maximum(spread, least)).reshape(len(angle), -1))
    return np.concatenate(parts, axis=1)


def repeated(states: Array, edges: Numbers) -> Array:
    """Share of the instants of each of B blocks that have their like elsewhere in time: (B,).

    states: (N, k), in order of time; edges: (B + 1,), where blocks begin and end. Elsewhere is neither in the block nor
    in those beside it, which a motion leaves and enters slowly.
    """
    usual = np.sqrt(2 * states.var(axis=0).sum())
    steps = np.linalg.norm(np.diff(states, axis=0, append=states[-2:-1]), axis=1)
    limits = np.clip(0.5 * steps, NEAREST * usual, NEAR * usual)
    squares = np.square(states).sum(axis=1)
    shares = np.zeros(len(edges) - 1)
    for block in range(len(shares)):
        rows = np.unique(np.linspace(edges[block], edges[block + 1] - 1, ASKED).round().astype(np.int64))
        near = slice(edges[max(block - 1, 0)], edges[min(block + 2, len(shares))])
        elsewhere = np.delete(np.arange(len(states)), near)
        if len(elsewhere):
            nearest = (squares[elsewhere] - 2 * states[rows] @ states[elsewhere].T).min(axis=1) + squares[rows]
            shares[block] = np.mean(np.sqrt(np.maximum(nearest, 0.0)) <= limits[rows])
    return shares

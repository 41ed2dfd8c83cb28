"""What to judge on: parts of a recording whose motion the rest of it does not repeat, where there are any."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lipcore.data.repetition import REPEATED, features, groups, period, repeated, share_repeated
from lipcore.data.samples import Samples
from lipcore.data.splits import GUARD_S, Mask, Numbers, Parts, SplitError, choose, guarded

LEAST_ROWS, LEAST_BLOCKS, MOST_BLOCKS = 60, 4, 20
"""Fewest rows that some are held out of, and how many blocks a recording is divided into."""
BLOCK_ROWS, BLOCK_S = 15, 4 * GUARD_S
"""Rows and seconds that a block has at least."""
SHARE = 0.25
"""Of the blocks, held out."""
MOST_EPISODES, MOST_SHARE = 50, 0.5
"""Most episodes that count as blocks, and largest share that is held out, unless more is asked for: or twice that."""


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
    count = _count(samples.rows(order))
    if count < LEAST_BLOCKS:
        lasts = float(np.maximum(np.diff(samples.t[order]), 0.0).sum())
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


def unrepeated(samples: Samples, joint_types: Sequence[str], share: float, seed: int) -> list[tuple[int, int]] | None:
    """Stretches of rows, first and last exclusive, to hold out in place of the last part, where that repeats motion of
    the rest: groups of blocks that repeat each other and nothing else. None where the last part does not, or nothing
    else is better.

    A block is a period of the motion, an episode, or one of equal stretches. samples: in order of episode and time;
    joint_types: (n,); share, seed: see `splits.choose`.
    """
    if len(samples) < LEAST_ROWS:
        return None
    states = features(samples, joint_types)
    first = round((1 - share) * len(samples))
    if share_repeated(states[:first], states[first:]) < REPEATED:
        return None
    edges = _edges(samples, joint_types)
    if edges is None:
        return None
    group, lengths = groups(states, edges), np.diff(edges)
    sizes = np.bincount(group, weights=lengths).astype(np.int64)
    if len(sizes) < 2:
        return None
    held = np.repeat(choose(sizes, share, seed)[group], lengths)
    if held.mean() > max(share, min(MOST_SHARE, 2 * share)) or share_repeated(states[~held], states[held]) >= REPEATED:
        return None
    border = np.flatnonzero(np.diff(np.concatenate([[False], held, [False]])))
    return list(zip(border[::2].tolist(), border[1::2].tolist(), strict=True))


def _edges(samples: Samples, joint_types: Sequence[str]) -> Numbers | None:
    """Where blocks begin and end that may repeat each other; None where there is too little for any."""
    episodes = samples.episodes()
    if LEAST_BLOCKS <= len(episodes) <= MOST_EPISODES:
        return np.array([0, *(each.stop for each in episodes)], np.int64)
    again = period(samples, joint_types) if len(episodes) == 1 else None
    if again is not None:
        number = (samples.t - samples.t[0]) / again
        several = max(1, int(np.ceil(number[-1] / MOST_BLOCKS)))
        begins = np.flatnonzero(np.diff(np.floor(number / several))) + 1
        return np.array([0, *begins.tolist(), len(samples)], np.int64)
    count = _count(samples)
    return None if count < LEAST_BLOCKS else np.linspace(0, len(samples), count + 1).round().astype(np.int64)


def _count(samples: Samples) -> int:
    """Blocks of equal length that samples in order are divided into."""
    lasts = float(np.maximum(np.diff(samples.t), 0.0).sum())
    return int(min(MOST_BLOCKS, len(samples) // BLOCK_ROWS, lasts // BLOCK_S))

"""What to judge on: parts of a recording whose motion the rest of it does not repeat, and parts at its edge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lipcore.data import repetition
from lipcore.data.repetition import features, groups, nearest, period, repeated, share_repeated
from lipcore.data.samples import Array, Samples
from lipcore.data.splits import GUARD_S, Mask, Numbers, Parts, SplitError, choose, guarded


@dataclass(frozen=True)
class HoldOutOptions:
    """Sizes of what is held out."""

    min_rows: int = 60
    """Min rows of a recording of which some are held out."""
    min_blocks: int = 4
    max_blocks: int = 20
    """Blocks that a recording is divided into."""
    block_rows: int = 15
    """Min rows of a block."""
    block_s: float = 4 * GUARD_S
    """Min duration of a block, s."""


OPTIONS = HoldOutOptions()


@dataclass(frozen=True)
class HoldOut:
    """Which rows to train on and which to judge by."""

    parts: Parts
    blocks: int
    """Blocks that are held out."""
    repeats: bool
    """Whether the whole recording repeats itself, so that held-out blocks repeat others, except those of the edge."""
    edge: Mask
    """Held-out rows at the edge of the data, (N,)."""
    edge_blocks: int
    """Held-out blocks at the edge of the data."""


def hold_out(samples: Samples, joint_types: Sequence[str]) -> HoldOut:
    """Hold about a quarter of the samples out: blocks at the edge of the data, and blocks from all over the recording.

    Of fewer than six blocks one is held out, and none is at the edge. None is either if no group of blocks that repeat
    each other is small enough. Raise SplitError if there is too little to hold any out.
    """
    if len(samples) < OPTIONS.min_rows:
        raise SplitError("rows", len(samples), f"at least {OPTIONS.min_rows} to hold some out")
    order = np.lexsort((samples.t, samples.episode))
    count = _count(samples.rows(order))
    if count < OPTIONS.min_blocks:
        lasts = float(np.maximum(np.diff(samples.t[order]), 0.0).sum())
        raise SplitError(
            "seconds", round(lasts, 3), f"at least {OPTIONS.min_blocks * OPTIONS.block_s:g} to hold some out"
        )
    edges = np.linspace(0, len(samples), count + 1).round().astype(np.int64)
    number = max(1, round(0.25 * count))
    states = features(samples.rows(order), joint_types)
    outer = _outer_blocks(states, edges, number // 2)
    new = repeated(states, edges) < repetition.OPTIONS.repeated_share
    repeats = int(new.sum()) < max(1, number // 2)
    inner = np.flatnonzero(~outer if repeats else new & ~outer)
    several = min(number - int(outer.sum()), len(inner))
    held = outer.copy()
    held[inner[((np.arange(several) + 0.5) * len(inner) / several).astype(np.int64)]] = True
    lengths = np.diff(edges)
    parts = guarded(samples.episode, samples.t, order, np.repeat(held, lengths), GUARD_S)
    edge = np.zeros(len(samples), dtype=bool)
    edge[order] = np.repeat(outer, lengths)
    return HoldOut(parts, int(held.sum()), repeats, edge & parts.held_out, int(outer.sum()))


def unrepeated(samples: Samples, joint_types: Sequence[str], share: float, seed: int) -> list[tuple[int, int]] | None:
    """Stretches of rows, first and last exclusive, to hold out in place of the last part, where that repeats motion of
    the rest: groups of blocks that repeat each other and nothing else. None where the last part does not, or nothing
    else is better.

    A block is a period of the motion, an episode, or one of equal stretches. samples: in order of episode and time;
    joint_types: (n,); share, seed: see `splits.choose`. Of the rows up to twice the share is held out, half at most
    unless more is asked for.
    """
    if len(samples) < OPTIONS.min_rows:
        return None
    states = features(samples, joint_types)
    first = round((1 - share) * len(samples))
    if share_repeated(states[:first], states[first:]) < repetition.OPTIONS.repeated_share:
        return None
    edges = _edges(samples, joint_types)
    if edges is None:
        return None
    group, lengths = groups(states, edges), np.diff(edges)
    sizes = np.bincount(group, weights=lengths).astype(np.int64)
    if len(sizes) < 2:
        return None
    held = np.repeat(choose(sizes, share, seed)[group], lengths)
    if (
        held.mean() > max(share, min(0.5, 2 * share))
        or share_repeated(states[~held], states[held]) >= repetition.OPTIONS.repeated_share
    ):
        return None
    border = np.flatnonzero(np.diff(np.concatenate([[False], held, [False]])))
    return list(zip(border[::2].tolist(), border[1::2].tolist(), strict=True))


def _edges(samples: Samples, joint_types: Sequence[str]) -> Numbers | None:
    """Where blocks begin and end that may repeat each other; None where there is too little for any."""
    episodes = samples.episodes()
    if OPTIONS.min_blocks <= len(episodes) <= 50:
        return np.array([0, *(each.stop for each in episodes)], np.int64)
    again = period(samples, joint_types) if len(episodes) == 1 else None
    if again is not None:
        number = (samples.t - samples.t[0]) / again
        several = max(1, int(np.ceil(number[-1] / OPTIONS.max_blocks)))
        begins = np.flatnonzero(np.diff(np.floor(number / several))) + 1
        return np.array([0, *begins.tolist(), len(samples)], np.int64)
    count = _count(samples)
    return None if count < OPTIONS.min_blocks else np.linspace(0, len(samples), count + 1).round().astype(np.int64)


def _outer_blocks(states: Array, edges: Numbers, most: int) -> Mask:
    """Whether each of B blocks is at the edge of the data, (B,): `most` blocks at most.

    One group of blocks that repeat each other is chosen after another: the furthest from all blocks that are not chosen
    yet. The distance is that of the median instant. Blocks next to its own are no part of it: motion enters and leaves
    a block slowly. Arguments as of `nearest`.
    """
    group, outer = groups(states, edges), np.zeros(len(edges) - 1, dtype=bool)
    distances = [each for _, each in nearest(states, edges)]

    def distance(members: Mask) -> float:
        alone = outer | members
        parts = []
        for block in np.flatnonzero(members):
            others = ~alone
            others[max(block - 1, 0) : block + 2] = False
            parts.append(distances[block][:, others].min(axis=1))
        return float(np.median(np.concatenate(parts)))

    while True:
        open_groups = [group == each for each in np.unique(group[~outer])]
        small = [each for each in open_groups if int(each.sum()) <= most - int(outer.sum())]
        if not small:
            return outer
        outer |= max(small, key=distance)


def _count(samples: Samples) -> int:
    """Blocks of equal length that samples in order are divided into."""
    lasts = float(np.maximum(np.diff(samples.t), 0.0).sum())
    return int(min(OPTIONS.max_blocks, len(samples) // OPTIONS.block_rows, lasts // OPTIONS.block_s))

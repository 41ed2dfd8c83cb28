"""Selection of the held-out part: motion that the rest of a recording does not repeat, and motion at its edge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lipcore.data import repetition
from lipcore.data.repetition import (
    features,
    find_period,
    group_blocks,
    measure_repeated_share,
    measure_repeated_shares,
    nearest,
)
from lipcore.data.samples import Array, Samples
from lipcore.data.splits import GUARD_S, Mask, Numbers, SplitError, SplitRows, apply_guard, choose_stretches


@dataclass(frozen=True)
class HoldOutOptions:
    """Sizes of the held-out part."""

    min_rows: int = 60
    """Min rows of a recording for a held-out part."""
    min_blocks: int = 4
    max_blocks: int = 20
    """Limits of the number of blocks that a recording is divided into."""
    block_rows: int = 15
    """Min rows of a block."""
    block_s: float = 4 * GUARD_S
    """Min duration of a block, s."""


OPTIONS = HoldOutOptions()


@dataclass(frozen=True)
class HoldOut:
    """Rows for training, and held-out rows for evaluation."""

    parts: SplitRows
    blocks: int
    """Number of held-out blocks."""
    repeats: bool
    """Whether the whole recording repeats itself. Held-out blocks then repeat others, except those of the edge."""
    edge: Mask
    """Held-out rows at the edge of the data, (N,)."""
    edge_blocks: int
    """Number of held-out blocks at the edge of the data."""


def hold_out(samples: Samples, joint_types: Sequence[str]) -> HoldOut:
    """Hold about a quarter of the samples out: blocks at the edge of the data, and blocks spread over the recording.

    If there are fewer than six blocks, one is held out, and none is at the edge. There is also none at the edge if all
    groups of blocks that repeat each other are too large. Raise SplitError if there are too few samples.
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
    new = measure_repeated_shares(states, edges) < repetition.OPTIONS.repeated_share
    repeats = int(new.sum()) < max(1, number // 2)
    inner = np.flatnonzero(~outer if repeats else new & ~outer)
    several = min(number - int(outer.sum()), len(inner))
    held = outer.copy()
    held[inner[((np.arange(several) + 0.5) * len(inner) / several).astype(np.int64)]] = True
    lengths = np.diff(edges)
    parts = apply_guard(samples.episode, samples.t, order, np.repeat(held, lengths), GUARD_S)
    edge = np.zeros(len(samples), dtype=bool)
    edge[order] = np.repeat(outer, lengths)
    return HoldOut(parts, int(held.sum()), repeats, edge & parts.held_out, int(outer.sum()))


def find_unrepeated(
    samples: Samples, joint_types: Sequence[str], share: float, seed: int
) -> list[tuple[int, int]] | None:
    """Return stretches of rows, first and last exclusive, to hold out instead of the last part, if it repeats the rest.

    They are groups of blocks that repeat each other and nothing else. Return None if the last part does not repeat the
    rest, or if no other part is better.

    A block is a period of the motion, an episode, or one of equal stretches. samples: in order of episode and time;
    joint_types: (n,); share, seed: see `splits.choose_stretches`. Up to twice the share of the rows is held out, at
    most half unless the share is larger.
    """
    if len(samples) < OPTIONS.min_rows:
        return None
    states = features(samples, joint_types)
    first = round((1 - share) * len(samples))
    if measure_repeated_share(states[:first], states[first:]) < repetition.OPTIONS.repeated_share:
        return None
    edges = _edges(samples, joint_types)
    if edges is None:
        return None
    group, lengths = group_blocks(states, edges), np.diff(edges)
    sizes = np.bincount(group, weights=lengths).astype(np.int64)
    if len(sizes) < 2:
        return None
    held = np.repeat(choose_stretches(sizes, share, seed)[group], lengths)
    if (
        held.mean() > max(share, min(0.5, 2 * share))
        or measure_repeated_share(states[~held], states[held]) >= repetition.OPTIONS.repeated_share
    ):
        return None
    border = np.flatnonzero(np.diff(np.concatenate([[False], held, [False]])))
    return list(zip(border[::2].tolist(), border[1::2].tolist(), strict=True))


def _edges(samples: Samples, joint_types: Sequence[str]) -> Numbers | None:
    """Return the borders of blocks that may repeat each other; None if there are too few samples."""
    episodes = samples.episodes()
    if OPTIONS.min_blocks <= len(episodes) <= 50:
        return np.array([0, *(each.stop for each in episodes)], np.int64)
    again = find_period(samples, joint_types) if len(episodes) == 1 else None
    if again is not None:
        number = (samples.t - samples.t[0]) / again
        several = max(1, int(np.ceil(number[-1] / OPTIONS.max_blocks)))
        begins = np.flatnonzero(np.diff(np.floor(number / several))) + 1
        return np.array([0, *begins.tolist(), len(samples)], np.int64)
    count = _count(samples)
    return None if count < OPTIONS.min_blocks else np.linspace(0, len(samples), count + 1).round().astype(np.int64)


def _outer_blocks(states: Array, edges: Numbers, most: int) -> Mask:
    """Return a mask of the blocks at the edge of the data, (B,), with at most `most` blocks.

    Groups of blocks that repeat each other are chosen one after another, each the furthest from all blocks that are not
    chosen yet. The distance is that of the median instant. Neighbouring blocks do not count, because motion enters and
    leaves a block slowly. Arguments: see `nearest`.
    """
    group, outer = group_blocks(states, edges), np.zeros(len(edges) - 1, dtype=bool)
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
    """Return the number of blocks of equal length for samples in order."""
    lasts = float(np.maximum(np.diff(samples.t), 0.0).sum())
    return int(min(OPTIONS.max_blocks, len(samples) // OPTIONS.block_rows, lasts // OPTIONS.block_s))

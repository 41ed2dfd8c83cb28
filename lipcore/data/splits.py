"""Splits of a recording into training rows and held-out rows: whole stretches, never single rows.

Neighbouring samples are nearly equal, and a low-pass spreads each over its neighbours. If single rows were held
out, training on their neighbours would almost reveal them. Therefore whole episodes or contiguous stretches are held
out. Rows next to the other side belong to neither side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from lipcore.data.samples import Array, Samples
from lipcore.data.signals import CUTOFF

Kind = Literal["episodes", "last", "blocks"]
"""episodes: whole ones, chosen by the seed; last: the end of the recording; blocks: some of equal stretches, chosen
by the seed."""
GUARD_S = 1.0 / CUTOFF
"""One period of the usual low-pass, which spreads a sample over about that long on both sides, s."""

Mask = NDArray[np.bool_]
Numbers = NDArray[np.int64]


class SplitError(ValueError):
    """These samples cannot be split as requested. field, value, expected: what is wrong."""

    def __init__(self, field: str, value: object, expected: str) -> None:
        super().__init__(f"{field} is {value!r}, expected {expected}")
        self.field, self.value, self.expected = field, value, expected


@dataclass(frozen=True)
class Split:
    """A choice of rows to hold out. Raise SplitError if a value is impossible."""

    kind: Kind = "last"
    share: float = 0.3
    """Share of the rows to hold out, as nearly as whole episodes or blocks allow."""
    blocks: int = 10
    """Number of equal stretches that kind `blocks` chooses from."""
    guard_s: float = GUARD_S
    """Rows within this time of a row of the other side are left out, on both sides, s."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise SplitError("kind", self.kind, f"one of {', '.join(get_args(Kind))}")
        if not 0 < self.share < 1:
            raise SplitError("share", self.share, "a share between 0 and 1")
        if self.blocks < 2:
            raise SplitError("blocks", self.blocks, "at least 2")
        if not 0 <= self.guard_s < float("inf"):
            raise SplitError("guard_s", self.guard_s, "at least 0 s")


@dataclass(frozen=True)
class SplitRows:
    """Masks of the training rows and the held-out rows, (N,) each."""

    train: Mask
    held_out: Mask

    @property
    def guarded(self) -> int:
        """Return the number of rows left out between the two."""
        return len(self.train) - int(np.count_nonzero(self.train)) - int(np.count_nonzero(self.held_out))


def split(episode: Numbers, t: Array, how: Split, stretches: Sequence[Sequence[int]] | None = None) -> SplitRows:
    """Return the training rows and the held-out rows of a recording.

    episode: (N,), equal over one contiguous recording; t: (N,) s; stretches: rows to hold out instead of those that
    `how` chooses, first and last exclusive, in order of episode and time.

    Episodes form one course of time, in the order of their numbers, while time rises from one to the next. Pieces of a
    recording with gaps are therefore as near as their times. Episodes with restarted clocks are far from each other.

    Equal arguments return equal parts on every machine and in every release. Rows in another order return the same
    parts in that order.

    Raise SplitError if a side has no rows left, ValueError for wrong shapes or times that are not finite.
    """
    if episode.ndim != 1 or episode.shape != t.shape:
        raise ValueError(f"t has shape {t.shape}, expected that of episode, {episode.shape}, one number a row")
    if not np.isfinite(t).all():
        raise ValueError("t has values that are not finite")
    if len(t) < 2:
        raise SplitError("rows", len(t), "at least 2, one for each side")
    order = np.lexsort((t, episode))
    held = _CHOOSERS[how.kind](episode[order], how) if stretches is None else _within(stretches, len(t))
    parts = apply_guard(episode, t, order, held, how.guard_s)
    for side, rows in (("held out", parts.held_out), ("to train on", parts.train)):
        if not rows.any():
            raise SplitError(
                "guard_s", how.guard_s, f"a smaller value: all rows {side} are closer than that to the other side"
            )
    return parts


def apply_guard(episode: Numbers, t: Array, order: Numbers, held: Mask, guard_s: float) -> SplitRows:
    """Return both sides without the rows next to the other one.

    episode, t: (N,), of rows in any order; order: (N,), their indices by episode and time; held: (N,) mask in that
    order; guard_s: min time to a row of the other side, s.
    """
    near = _near_other_side(episode[order], t[order], held, guard_s)
    parts = SplitRows(np.empty(len(t), dtype=bool), np.empty(len(t), dtype=bool))
    parts.train[order], parts.held_out[order] = ~held & ~near, held & ~near
    return parts


def choose_stretches(lengths: Numbers, share: float, seed: int) -> Mask:
    """Return which of several stretches with lengths (K,) contain about `share` of all rows: (K,).

    At least one is chosen and one is not, K ≥ 2. The seed decides the order in which stretches are tried. A stretch is
    chosen if that brings the number of rows nearer to the share.
    """
    if len(lengths) < 2:
        raise SplitError("episodes", len(lengths), "at least 2: hold out `last` or `blocks` instead")
    # a hash, because random number generators may change from release to release, and the same rows must be held
    # out again
    order = sorted(range(len(lengths)), key=lambda each: sha256(f"{seed}/{each}".encode()).digest())
    rows, goal = lengths.tolist(), share * int(lengths.sum())
    chosen: list[int] = []
    held = 0
    for each in order:
        if len(chosen) < len(lengths) - 1 and abs(held + rows[each] - goal) < abs(held - goal):
            chosen.append(each)
            held += rows[each]
    mask = np.zeros(len(lengths), dtype=bool)
    mask[chosen or [min(order, key=lambda each: rows[each])]] = True
    return mask


def select_rows(samples: Samples, rows: Mask) -> Samples:
    """Return the samples of one side. rows: (N,) mask. An interrupted episode becomes several."""
    index = np.flatnonzero(rows)
    begins = (np.diff(index) > 1) | (np.diff(samples.episode[index]) != 0)
    numbered = np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(begins, dtype=np.int64)])
    return replace(samples.rows(index), episode=numbered[: len(index)])


def _within(stretches: Sequence[Sequence[int]], rows: int) -> Mask:
    held = np.zeros(rows, dtype=bool)
    for first, last in stretches:
        held[first:last] = True
    return held


def _episodes(episode: Numbers, how: Split) -> Mask:
    lengths = np.unique(episode, return_counts=True)[1]
    return np.asarray(np.repeat(choose_stretches(lengths, how.share, how.seed), lengths))


def _last(episode: Numbers, how: Split) -> Mask:
    rows = len(episode)
    first = min(max(rows - round(how.share * rows), 1), rows - 1)
    return np.arange(rows) >= first


def _blocks(episode: Numbers, how: Split) -> Mask:
    if how.blocks > len(episode):
        raise SplitError("blocks", how.blocks, f"at most the number of rows, {len(episode)}")
    edges = np.linspace(0, len(episode), how.blocks + 1).round().astype(np.int64)
    lengths = edges[1:] - edges[:-1]
    return np.asarray(np.repeat(choose_stretches(lengths, how.share, how.seed), lengths))


_CHOOSERS: dict[Kind, Callable[[Numbers, Split], Mask]] = {"episodes": _episodes, "last": _last, "blocks": _blocks}
"""Returns the held-out rows of each kind, ordered by episode and time, before the guard."""


def _near_other_side(episode: Numbers, t: Array, held: Mask, guard_s: float) -> Mask:
    """Return whether a row of the other side is within `guard_s` in one course of time, for rows in order: (N,)."""
    back = (np.diff(episode) != 0) & (np.diff(t) <= 0)
    edges = np.flatnonzero(back | (held[1:] != held[:-1])) + 1
    lengths = np.diff(np.concatenate([[0], edges, [len(t)]]))
    # between edges all rows are of one side; the next stretch is of the other side, or of another course of time
    before = np.concatenate([[-np.inf], np.where(back[edges - 1], -np.inf, t[edges - 1])])
    after = np.concatenate([np.where(back[edges - 1], np.inf, t[edges]), [np.inf]])
    return np.asarray((t - np.repeat(before, lengths) <= guard_s) | (np.repeat(after, lengths) - t <= guard_s))

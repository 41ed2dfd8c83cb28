"""One contiguous part of a recording: its columns on an even clock, and what of its samples comes out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.preparation.causal import CausalFilter
from lipcore.preparation.filtering import QUANTITIES
from lipcore.preparation.resampling import BLOCK, between, interpolate


@dataclass(frozen=True)
class Part:
    """One contiguous part.

    rows: of those kept; at: even times it is put on, None where its own are even; inner: samples between the ends that
    are cut off; taken: positions among those, all where None; out: where they come to lie.
    """

    rows: slice
    at: Array | None
    inner: slice
    taken: NDArray[np.int64] | Array | None
    out: slice


class Kept(Mapping[str, Array]):
    """Columns, read when asked for, without the rows that are left out."""

    def __init__(self, joint: Mapping[str, Array], kept: NDArray[np.bool_] | None) -> None:
        self.joint, self.kept = joint, kept

    def __getitem__(self, name: str) -> Array:
        return self.joint[name] if self.kept is None else self.joint[name][self.kept]

    def __iter__(self) -> Iterator[str]:
        return iter(self.joint)

    def __len__(self) -> int:
        return len(self.joint)


class OnClock(Kept):
    """Columns of one part, put on its even clock when asked for."""

    def __init__(self, part: Part, joint: Mapping[str, Array], times: Array) -> None:
        super().__init__(joint, None)
        self.part, self.times = part, times

    def __getitem__(self, name: str) -> Array:
        values = self.joint[name][self.part.rows]
        return values if self.part.at is None else interpolate(self.times[self.part.rows], values, self.part.at)


def in_blocks(causal: CausalFilter, signals: dict[str, Array]) -> Iterator[tuple[str, Array]]:
    """All quantities of one part of one joint, as a live stream has them."""
    rows = len(signals["q"])
    found = {name: np.empty(rows - 2 * causal.lag) for name in QUANTITIES}
    done = 0
    for begin in range(0, rows, BLOCK):
        block = causal.batch({name: values[begin : begin + BLOCK, None] for name, values in signals.items()})
        for name, values in block.items():
            found[name][done : done + len(values)] = values[:, 0]
        done += len(block["q"])
    for name in QUANTITIES:
        yield name, found.pop(name)


def inner(part: Part, values: Array) -> Array:
    """Of samples of a part, those that come out."""
    between_ends = values[part.inner]
    return between_ends if part.taken is None else taken_at(between_ends, part.taken)


def taken_at(values: Array, positions: NDArray[np.int64] | Array) -> Array:
    """Values at whole positions, or between them."""
    if positions.dtype.kind == "i":
        return np.asarray(values[positions])
    return between(values, np.asarray(positions, dtype=np.float64))

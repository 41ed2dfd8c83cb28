"""Splits of a recording into training and test samples: later rows, single seconds, or another motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.real.recordings import TRAIN, Parts
from lipcore.data.samples import Array, Samples

GUARD_S = 0.5
"""Time between training and test samples: two periods of the low-pass."""
MIN_TEST_S = 2.0
MAX_TEST_ROWS = 2000
"""Max rows of a test; more are thinned evenly."""
FIRST_S = (5, 10, 30)
EARLY = "first-60pct"
"""Split of short recordings: training on the first 60 %, test on the last 30 %."""
SECONDS = "seconds"
"""Split with single seconds as the test: the training saw the motion before and after them."""
TEST_SHARE = 0.2
MAX_SHORT_S = 10.0
"""Max duration of a short recording."""


@dataclass(frozen=True)
class Split:
    """Training and test samples."""

    train: Samples
    test: Samples

    @property
    def train_s(self) -> float:
        """Duration of the training samples, s."""
        return duration(self.train)


def splits(parts: Parts) -> tuple[Mapping[str, Split], Mapping[str, str]]:
    """Return the splits of a recording by name, and reasons for splits that it is too short for."""
    train = parts[TRAIN]
    at, found, skipped = elapsed(train), {}, {}
    total = duration(train)
    for seconds in FIRST_S:
        name = f"first-{seconds}s"
        if total < seconds + GUARD_S + MIN_TEST_S:
            skipped[name] = f"{total:.1f} s recorded"
        else:
            found[name] = Split(train.rows(at < seconds), train.rows(at >= seconds + GUARD_S))
    found["last-30pct"] = Split(train.rows(at < 0.7 * total), train.rows(at >= 0.7 * total + GUARD_S))
    found[SECONDS] = _hold_out_seconds(train, at)
    if total <= MAX_SHORT_S:
        rows = len(train)
        found[EARLY] = Split(train.rows(slice(0, int(0.6 * rows))), train.rows(slice(round(0.7 * rows), None)))
    for part, samples in parts.items():
        if part != TRAIN:
            found[part] = Split(train, samples)
    return {name: Split(each.train, thinned(each.test)) for name, each in found.items()}, skipped


def _hold_out_seconds(samples: Samples, at: Array) -> Split:
    """Hold out random seconds. Rows closer than GUARD_S to them are in neither part, and each piece is an episode."""
    second = at.astype(np.int64)
    count = int(second[-1]) + 1
    chosen = np.random.default_rng(0).permutation(count)[: max(1, round(TEST_SHARE * count))]
    held = np.isin(second, chosen)
    near = np.any([(at > one - GUARD_S) & (at < one + 1 + GUARD_S) for one in chosen], axis=0)

    def part(mask: NDArray[np.bool_]) -> Samples:
        rows = np.flatnonzero(mask)
        begins = (np.diff(rows, prepend=rows[0]) > 1) | (np.diff(samples.episode[rows], prepend=0) != 0)
        return replace(samples.rows(rows), episode=np.cumsum(begins, dtype=np.int64))

    return Split(part(~near), part(held))


def elapsed(samples: Samples) -> Array:
    """Return the time of each row since the first, s, (N,), with one step between episodes."""
    steps = np.diff(samples.t)
    new = np.diff(samples.episode) != 0
    usual = float(np.median(steps[~new]))
    return np.concatenate([[0.0], np.cumsum(np.where(new, usual, steps))])


def duration(samples: Samples) -> float:
    """Return the duration of the samples without the time between episodes, s."""
    at = elapsed(samples)
    return float(at[-1]) * len(at) / (len(at) - 1)


def thinned(samples: Samples, max_rows: int = MAX_TEST_ROWS) -> Samples:
    """Return at most `max_rows` rows, evenly spaced."""
    if len(samples) <= max_rows:
        return samples
    return samples.rows(np.linspace(0, len(samples) - 1, max_rows).round().astype(np.int64))

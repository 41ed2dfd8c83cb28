"""What of a recording is learnt from, and what is tested on: always later rows, or another motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from benchmarks.real.recordings import TRAIN, Parts
from lipcore.data.samples import Array, Samples

GUARD_S = 0.5
"""Rows between training and test that are in neither, s: two periods of the low-pass."""
MIN_TEST_S = 2.0
"""Shortest test, s."""
MAX_TEST_ROWS = 2000
"""Tests of more rows are thinned evenly."""
FIRST_S = (5, 10, 30)
EARLY = "first-60pct"
"""Learns from the first 60 % and tests on the last 30 %, of short recordings only."""
SHORT_S = 10.0
"""A recording is short for EARLY if it lasts at most so long, s."""


@dataclass(frozen=True)
class Split:
    """Rows to learn from, and rows to test on."""

    train: Samples
    test: Samples

    @property
    def train_s(self) -> float:
        """Duration of what is learnt from, s."""
        return duration(self.train)


def splits(parts: Parts) -> tuple[Mapping[str, Split], Mapping[str, str]]:
    """Return the splits of a recording by name, and of those that it is too short for the reason."""
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
    if total <= SHORT_S:
        rows = len(train)
        found[EARLY] = Split(train.rows(slice(0, int(0.6 * rows))), train.rows(slice(round(0.7 * rows), None)))
    for part, samples in parts.items():
        if part != TRAIN:
            found[part] = Split(train, samples)
    return {name: Split(each.train, thinned(each.test)) for name, each in found.items()}, skipped


def elapsed(samples: Samples) -> Array:
    """Return the time of each row since the first, s, (N,); an episode follows one step after the one before."""
    steps = np.diff(samples.t)
    new = np.diff(samples.episode) != 0
    usual = float(np.median(steps[~new]))
    return np.concatenate([[0.0], np.cumsum(np.where(new, usual, steps))])


def duration(samples: Samples) -> float:
    """Return how long the samples last, s, without the time between episodes."""
    at = elapsed(samples)
    return float(at[-1]) * len(at) / (len(at) - 1)


def thinned(samples: Samples, most: int = MAX_TEST_ROWS) -> Samples:
    """Return at most `most` rows, evenly spaced."""
    if len(samples) <= most:
        return samples
    return samples.rows(np.linspace(0, len(samples) - 1, most).round().astype(np.int64))

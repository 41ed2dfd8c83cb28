"""What an update costs after few and after many samples: it must not grow."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lipcore.model import TorqueModel
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from service.bench.timing import no_collection

CHUNK = 100
"""Rows that are learnt together and timed: a batch."""
TIMED, SOLVED = 20, 3
"""Chunks and solutions that are timed at every size."""
_LONG = 1000
"""Rows that are learnt together in between."""


@dataclass(frozen=True)
class Cost:
    """After `samples`: µs to learn one more, medians over chunks; ms to solve for a new revision."""

    samples: int
    learn: float
    solve: float


def update_costs(model: TorqueModel, rows: Rows, sizes: Sequence[int], forgetting_s: float | None) -> list[Cost]:
    """Learn rows one chunk after the other and time it after each of `sizes`, ascending; raise ValueError for too few.

    Rows are needed for the sizes and the chunks that are timed after the last.
    """
    if len(rows) < sizes[-1] + TIMED * CHUNK:
        raise ValueError(f"rows has {len(rows)} rows, expected at least {sizes[-1] + TIMED * CHUNK}")
    online, at, found = OnlineModel.start(model, forgetting_s), 0, []
    with no_collection():
        for size in sizes:
            for part in _chunks(at, size, _LONG):
                online = online.learn(rows.take(part))
            at = size + TIMED * CHUNK
            times = []
            for part in _chunks(size, at, CHUNK):
                chunk, began = rows.take(part), time.perf_counter()
                online = online.learn(chunk)
                times.append((time.perf_counter() - began) / len(chunk))
            solved = []
            for _ in range(SOLVED):
                began = time.perf_counter()
                online.model()
                solved.append(time.perf_counter() - began)
            found.append(Cost(size, 1e6 * float(np.median(times)), 1e3 * float(np.median(solved))))
    return found


def _chunks(start: int, stop: int, size: int) -> Iterator[slice]:
    """Slices that cover a range, none where it is empty."""
    for at in range(start, stop, size):
        yield slice(at, min(at + size, stop))

"""Cost of an update after few and after many samples."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.timing import no_collection
from lipcore.model.torque_model import TorqueModel
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel

CHUNK = 100
"""Rows of a timed batch."""
TIMED_CHUNKS, TIMED_SOLUTIONS = 40, 5
"""Timed batches and solutions at every size."""
_UNTIMED_CHUNK = 1000
"""Rows of a batch in between."""


@dataclass(frozen=True)
class Cost:
    """Cost after `samples`: median time to learn another one, µs, and to solve for a new revision, ms."""

    samples: int
    learn: float
    solve: float


def update_costs(model: TorqueModel, rows: Rows, sizes: Sequence[int], forgetting_s: float | None) -> list[Cost]:
    """Learn rows up to each of the ascending `sizes`, and time further batches there.

    All sizes are timed in turn, batch by batch, so that a temporary load on the machine affects all of them.

    Raises:
        ValueError: There are too few rows for the last size and its timed batches.
    """
    if len(rows) < sizes[-1] + TIMED_CHUNKS * CHUNK:
        raise ValueError(f"At least {sizes[-1] + TIMED_CHUNKS * CHUNK} rows are required; got {len(rows)}.")
    states, at = list[OnlineModel](), 0
    online = OnlineModel.start(model, forgetting_s)
    with no_collection():
        for size in sizes:
            for part in _chunks(at, size, _UNTIMED_CHUNK):
                online = online.learn(rows.take(part))
            states.append(online)
            at = size
        learn = [[0.0] * TIMED_CHUNKS for _ in sizes]
        solve = [[0.0] * TIMED_SOLUTIONS for _ in sizes]
        for number in range(TIMED_CHUNKS):
            for index, size in enumerate(sizes):
                start = size + number * CHUNK
                chunk, began = rows.take(slice(start, start + CHUNK)), time.perf_counter()
                states[index] = states[index].learn(chunk)
                learn[index][number] = (time.perf_counter() - began) / CHUNK
        for number in range(TIMED_SOLUTIONS):
            for index, state in enumerate(states):
                began = time.perf_counter()
                state.model()
                solve[index][number] = time.perf_counter() - began
    figures = zip(sizes, learn, solve, strict=True)
    return [Cost(size, 1e6 * float(np.median(one)), 1e3 * float(np.median(other))) for size, one, other in figures]


def _chunks(start: int, stop: int, size: int) -> Iterator[slice]:
    """Yield slices that cover a range."""
    for at in range(start, stop, size):
        yield slice(at, min(at + size, stop))

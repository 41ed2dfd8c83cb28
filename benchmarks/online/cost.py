"""What an update costs after few and after many samples: it must not grow."""

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
"""Rows that are learnt together and timed: a batch."""
TIMED, SOLVED = 40, 5
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
    """Learn rows up to each of `sizes`, ascending, then time more of them there; raise ValueError for too few.

    All sizes are timed in turn, chunk by chunk: what else the machine does meanwhile meets all of them alike. Rows are
    needed for the sizes and the chunks that are timed after the last.
    """
    if len(rows) < sizes[-1] + TIMED * CHUNK:
        raise ValueError(f"rows has {len(rows)} rows, expected at least {sizes[-1] + TIMED * CHUNK}")
    states, at = list[OnlineModel](), 0
    online = OnlineModel.start(model, forgetting_s)
    with no_collection():
        for size in sizes:
            for part in _chunks(at, size, _LONG):
                online = online.learn(rows.take(part))
            states.append(online)
            at = size
        learn = [[0.0] * TIMED for _ in sizes]
        solve = [[0.0] * SOLVED for _ in sizes]
        for number in range(TIMED):
            for index, size in enumerate(sizes):
                start = size + number * CHUNK
                chunk, began = rows.take(slice(start, start + CHUNK)), time.perf_counter()
                states[index] = states[index].learn(chunk)
                learn[index][number] = (time.perf_counter() - began) / CHUNK
        for number in range(SOLVED):
            for index, state in enumerate(states):
                began = time.perf_counter()
                state.model()
                solve[index][number] = time.perf_counter() - began
    figures = zip(sizes, learn, solve, strict=True)
    return [Cost(size, 1e6 * float(np.median(one)), 1e3 * float(np.median(other))) for size, one, other in figures]


def _chunks(start: int, stop: int, size: int) -> Iterator[slice]:
    """Slices that cover a range, none where it is empty."""
    for at in range(start, stop, size):
        yield slice(at, min(at + size, stop))

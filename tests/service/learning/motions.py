"""A double pendulum that moves slowly where it is recorded, and fast where it is observed."""

from __future__ import annotations

from typing import Any

import numpy as np

from lipcore.data.samples import Samples
from tests.service.data import stream

ROWS = 50
"""Rows of a batch."""
RATE = 100.0
OPTIONS = {"hyperparameter_samples": 30, "posterior_samples": 60, "max_iterations": 10}
"""Of a fit of about a second that gets both motions right."""


def slow() -> Samples:
    """What a version is trained on: at most 0.2 rad/s."""
    return stream(samples=120, speed=1.0, seed=1, n_sinusoids=20)


def fast(seed: int = 2) -> Samples:
    """What is observed: up to 0.7 rad/s, most of it beyond what the slow motion tells."""
    return stream(samples=20_000, speed=15.0, seed=seed, rate=RATE, n_sinusoids=20)


def batch(number: int, stream_id: str = "arm", moved: Samples | None = None) -> dict[str, Any]:
    """The batch of a number: ROWS rows of the fast motion, or of another one at its rate."""
    moved = fast() if moved is None else moved
    rows = slice(number * ROWS, (number + 1) * ROWS)
    body = {name: getattr(moved, name)[rows].tolist() for name in ("q", "dq", "ddq", "tau")}
    times = (np.arange(ROWS) + number * ROWS) / RATE
    return {"stream_id": stream_id, "sequence": number, "t": times.tolist(), **body}

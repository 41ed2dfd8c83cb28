"""What a model is told, as it comes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from service.client.call import Answer
from service.client.results.arrays import Array, Plain, array
from service.learning.live.schema import LiveLost, LiveStatus


@dataclass(frozen=True, eq=False)
class LivePart(Plain):
    """Rows of one stream that were judged since the last event, predicted by one revision before it learnt them.

    rows: all that were judged; counts: what became of them, by code; worst: (n) largest |tau - mean| of all of them in
    standard deviations of a measurement, NaN where none could be predicted; q: (n) positions of the newest row shown,
    rad (m). Of the rows shown, K of them: time: (K) Unix seconds; tau: (K, n) measured; mean: predicted; std: of the
    function, noise_std: (n) of a measurement around it, N·m; code: what became of each. NaN for what there is none of.
    """

    stream_id: str
    version: int
    revision: int
    rows: int
    counts: dict[str, int]
    worst: Array
    noise_std: Array
    q: Array
    time: Array
    tau: Array
    mean: Array
    std: Array
    code: tuple[str, ...]

    @property
    def innovation(self) -> Array:
        """(K, n) of tau - mean in standard deviations of a measurement."""
        found: Array = (self.tau - self.mean) / np.hypot(self.std, self.noise_std)
        return found


@dataclass(frozen=True, eq=False)
class LiveRows:
    """Rows that came."""

    parts: tuple[LivePart, ...]


Live = LiveRows | LiveStatus | LiveLost | None
"""Rows, where the model stands (about once a second), how many events were lost; None for what a later release adds."""


def read_live(answer: Answer) -> Live:
    """Read an event."""
    if answer.event == "rows":
        said = msgspec.json.decode(answer.body)
        return LiveRows(tuple(_part(each) for each in said["parts"]))
    if answer.event == "status":
        return LiveStatus.model_validate_json(answer.body)
    if answer.event == "lost":
        return LiveLost.model_validate_json(answer.body)
    return None


def _part(said: dict[str, Any]) -> LivePart:
    noise_std = array(said["noise_std"])
    shape = (len(said["time"]), len(noise_std))
    tau, mean, std = (array(said[name]).reshape(shape) for name in ("tau", "mean", "std"))
    return LivePart(
        stream_id=said["stream_id"],
        version=said["version"],
        revision=said["revision"],
        rows=said["rows"],
        counts=said["counts"],
        worst=array(said["worst"]),
        noise_std=noise_std,
        q=array(said["q"] or [None] * len(noise_std)),
        time=array(said["time"]),
        tau=tau,
        mean=mean,
        std=std,
        code=tuple(said["code"]),
    )

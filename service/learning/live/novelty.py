"""Which of the rows that are shown lie where a version's basis does not reach."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from lipcore.online.learner import uncovered
from service.learning.live.schema import LiveNovelty
from service.learning.live.thinning import Shown

MOST_LOOKED = 20
"""Rows of a stream that are looked at for one status: 14 ms of a thread at a thousand inducing outputs."""


class Novelty:
    """Gathers what is shown between two looks. From one thread at a time."""

    def __init__(self) -> None:
        self._shown: list[Shown] = []

    def add(self, shown: Shown) -> None:
        """Gather what is shown."""
        self._shown.append(shown)

    def look(self) -> list[LiveNovelty]:
        """Say of what was gathered, stream by stream, which rows the basis does not cover; start again."""
        gathered, self._shown = self._shown, []
        streams: dict[str, list[Shown]] = defaultdict(list)
        for shown in gathered:
            streams[shown.stream_id].append(shown)
        return [_look(stream_id, parts) for stream_id, parts in streams.items()]


def _look(stream_id: str, parts: list[Shown]) -> LiveNovelty:
    times: list[float] = []
    unknown = 0
    share = 1.0
    doubtful = [_doubtful(shown) for shown in parts]
    if (total := sum(len(places) for places in doubtful)) > MOST_LOOKED:
        share = MOST_LOOKED / total
    for shown, places in zip(parts, doubtful, strict=True):
        few = places[:: int(np.ceil(1 / share))]
        unknown += len(places) - len(few)
        if len(few):
            rows = shown.rows.take(few)
            times += np.round(rows.time[uncovered(shown.served.base, rows)], 6).tolist()
    return LiveNovelty(stream_id=stream_id, times=times, unknown=unknown)


def _doubtful(shown: Shown) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Places of rows that may lie beyond the basis.

    What the basis leaves open is part of the variance of every answer: where that is below the noise's, nothing
    more needs to be computed.
    """
    with np.errstate(invalid="ignore"):
        found = (shown.bare > shown.served.model.noise_std).any(axis=1)
    return np.flatnonzero(found)

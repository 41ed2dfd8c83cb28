"""From the batches of a moment to what is shown of them: few rows, but all of them counted."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.online.batch import Rows
from lipcore.online.learner import uncovered
from lipcore.vocabulary import CODES, LEARNT
from service.learning.ingest.derivation import EDGE
from service.learning.ingest.intake import Judged
from service.learning.live.schema import DECIMALS, LiveNovelty, LivePart
from service.models.loaded import Served

MOST_LOOKED = 20
"""Rows of a stream that are looked at for one status: 14 ms of a thread at a thousand inducing outputs."""


@dataclass(frozen=True)
class Picked:
    """The rows that are shown, (N,), and their predictions before they were learnt, (N, n), NaN where there are none.

    bare: the standard deviation without the floor of past errors, as `Screened` has it.
    """

    stream_id: str
    served: Served
    rows: Rows
    mean: Array
    std: Array
    bare: Array


def thinned(batches: Iterable[Judged], most: int) -> list[tuple[LivePart, Picked]]:
    """Show batches in their order, by stream and revision, with about `most` rows in all, one a part at least."""
    groups = [list(group) for _, group in groupby(batches, lambda each: (each.stream_id, id(each.served)))]
    total = sum(len(batch.rows) for group in groups for batch in group)
    return [_part(group, most, total) for group in groups]


def pick(code: NDArray[np.uint8], most: int) -> NDArray[np.int64]:
    """Places of at most so many rows (at least one) of these codes, in order, those at an edge left out.

    One of each stretch: the first that was kept out where there is one, so that no stretch looks calmer than it was.
    """
    places = np.flatnonzero(code != EDGE)
    if len(places) <= most:
        return places
    kept_out = code[places] != LEARNT
    starts = np.linspace(0, len(places), max(most, 1), endpoint=False).astype(np.int64)
    chosen = [start + int(kept_out[start:end].argmax()) for start, end in zip(starts, [*starts[1:], None], strict=True)]
    return places[chosen]


def _part(group: Sequence[Judged], most: int, total: int) -> tuple[LivePart, Picked]:
    served, stream_id = group[0].served, group[0].stream_id
    rows = Rows.concatenate([batch.rows for batch in group])
    mean, std, bare = (np.concatenate([_spread(batch, name) for batch in group]) for name in ("mean", "std", "bare"))
    noise = served.model.noise_std
    count = np.bincount(rows.code, minlength=len(CODES))
    chosen = pick(rows.code, max(most * len(rows) // max(total, 1), 1))
    picked = Picked(stream_id, served, rows.take(chosen), mean[chosen], std[chosen], bare[chosen])
    part = LivePart(
        stream_id=stream_id,
        version=served.version,
        revision=served.revision,
        rows=len(rows),
        counts={code: int(number) for code, number in zip(CODES, count, strict=True) if number},
        worst=_worst(rows.tau - mean, np.sqrt(std**2 + noise**2)),
        noise_std=noise.tolist(),
        time=np.round(picked.rows.time, DECIMALS).tolist(),
        q=np.round(picked.rows.q[picked.rows.time.argmax()], DECIMALS).tolist() if len(picked.rows) else [],
        tau=np.round(picked.rows.tau, DECIMALS).tolist(),
        mean=np.round(picked.mean, DECIMALS).tolist(),
        std=np.round(picked.std, DECIMALS).tolist(),
        code=[CODES[code] for code in picked.rows.code.tolist()],
    )
    return part, picked


def _spread(batch: Judged, name: str) -> Array:
    """Numbers of the rows that were predicted, (P, n), as those of all rows, (N, n), NaN where there are none."""
    values = np.full(batch.rows.q.shape, np.nan)
    values[batch.screened.predicted] = getattr(batch.screened, name)
    return values


def _worst(error: Array, total: Array) -> list[float | None]:
    """Largest |error| / total of each joint, None where no row was predicted."""
    known = np.isfinite(error).all(axis=1)
    if not known.any():
        return [None] * error.shape[1]
    worst: list[float | None] = np.round(np.abs(error[known] / total[known]).max(axis=0), 3).tolist()
    return worst


class Novelty:
    """Which of the rows shown between two looks lie beyond a version's basis. From one thread at a time."""

    def __init__(self) -> None:
        self._picked: list[Picked] = []

    def add(self, picked: Picked) -> None:
        """Gather rows that are shown."""
        self._picked.append(picked)

    def look(self) -> list[LiveNovelty]:
        """Return which of the rows gathered the basis does not cover, stream by stream; start again."""
        gathered, self._picked = self._picked, []
        streams: dict[str, list[Picked]] = defaultdict(list)
        for picked in gathered:
            streams[picked.stream_id].append(picked)
        return [_look(stream_id, parts) for stream_id, parts in streams.items()]


def _look(stream_id: str, parts: list[Picked]) -> LiveNovelty:
    times: list[float] = []
    unknown = 0
    share = 1.0
    doubtful = [_doubtful(picked) for picked in parts]
    if (total := sum(len(places) for places in doubtful)) > MOST_LOOKED:
        share = MOST_LOOKED / total
    for picked, places in zip(parts, doubtful, strict=True):
        few = places[:: int(np.ceil(1 / share))]
        unknown += len(places) - len(few)
        if len(few):
            rows = picked.rows.take(few)
            times += np.round(rows.time[uncovered(picked.served.base, rows)], 6).tolist()
    return LiveNovelty(stream_id=stream_id, times=times, unknown=unknown)


def _doubtful(picked: Picked) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Places of rows that may lie beyond the basis.

    What the basis leaves open is part of the variance of every answer: where that is below the noise's, nothing
    more needs to be computed.
    """
    with np.errstate(invalid="ignore"):
        doubtful = (picked.bare > picked.served.model.noise_std).any(axis=1)
    return np.flatnonzero(doubtful)

"""From the batches of a moment to what is shown of them: few rows, but all of them counted."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.online.batch import Rows
from lipcore.vocabulary import CODES, LEARNT
from service.learning.ingest.derivation import EDGE
from service.learning.ingest.screening import Screened
from service.learning.live.schema import DECIMALS, LivePart
from service.models.loaded import Served


class Judged(NamedTuple):
    """A batch that was logged: references to what is there anyway. rows: with their final codes."""

    served: Served
    stream_id: str
    rows: Rows
    screened: Screened


@dataclass(frozen=True)
class Shown:
    """The rows that are picked, (N,), and what the model said of them before it learnt them, (N, n), NaN: nothing.

    bare: the standard deviation without the floor of past errors, as `Screened` has it.
    """

    stream_id: str
    served: Served
    rows: Rows
    mean: Array
    std: Array
    bare: Array


def thinned(batches: Iterable[Judged], most: int) -> list[tuple[LivePart, Shown]]:
    """Tell of batches in their order, by stream and revision, with about `most` rows in all, one a part at least."""
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


def _part(group: Sequence[Judged], most: int, total: int) -> tuple[LivePart, Shown]:
    served, stream_id = group[0].served, group[0].stream_id
    rows = Rows.concatenate([batch.rows for batch in group])
    mean, std, bare = (np.concatenate([_spread(batch, name) for batch in group]) for name in ("mean", "std", "bare"))
    noise = served.model.noise_std
    count = np.bincount(rows.code, minlength=len(CODES))
    chosen = pick(rows.code, max(most * len(rows) // max(total, 1), 1))
    shown = Shown(stream_id, served, rows.take(chosen), mean[chosen], std[chosen], bare[chosen])
    part = LivePart(
        stream_id=stream_id,
        version=served.version,
        revision=served.revision,
        rows=len(rows),
        counts={code: int(number) for code, number in zip(CODES, count, strict=True) if number},
        worst=_worst(rows.tau - mean, np.sqrt(std**2 + noise**2)),
        noise_std=noise.tolist(),
        time=np.round(shown.rows.time, DECIMALS).tolist(),
        q=np.round(shown.rows.q[shown.rows.time.argmax()], DECIMALS).tolist() if len(shown.rows) else [],
        tau=np.round(shown.rows.tau, DECIMALS).tolist(),
        mean=np.round(shown.mean, DECIMALS).tolist(),
        std=np.round(shown.std, DECIMALS).tolist(),
        code=[CODES[code] for code in shown.rows.code.tolist()],
    )
    return part, shown


def _spread(batch: Judged, name: str) -> Array:
    """Numbers of the rows that were predicted, (P, n), as those of all rows, (N, n), NaN where there are none."""
    found = np.full(batch.rows.q.shape, np.nan)
    found[batch.screened.predicted] = getattr(batch.screened, name)
    return found


def _worst(error: Array, total: Array) -> list[float | None]:
    """Largest |error| / total of each joint, None where no row was predicted."""
    known = np.isfinite(error).all(axis=1)
    if not known.any():
        return [None] * error.shape[1]
    found: list[float | None] = np.round(np.abs(error[known] / total[known]).max(axis=0), 3).tolist()
    return found

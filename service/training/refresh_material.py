"""The rows of the log that a refresh learns from, as samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array, Samples
from lipcore.online.batch import Rows
from service.journal import log
from service.journal.payload import decode
from service.storage.database import Database
from service.training.refresh_scope import Scope

PAGE = 50
"""Events read at a time."""


@dataclass(frozen=True)
class Logged:
    """Samples of the log, None where there are none; found: rows before they were thinned; t of samples: event time."""

    samples: Samples | None
    found: int


def read(
    database: Database, model: str, joint_names: tuple[str, ...], scope: Scope, most: int, longest_step: float
) -> Logged:
    """Rows in scope that teach, at most `most` of them, thinned evenly.

    Sorted by stream and time; where time steps by more than `longest_step` seconds a new episode begins.
    """
    kept, found = _thinned(database, model, scope, most)
    if found == 0:
        return Logged(None, 0)
    rows, source = Rows.concatenate([part for part, _ in kept]), np.concatenate([stream for _, stream in kept])
    order = np.lexsort((rows.time, source))
    rows, source = rows.take(order), source[order]
    breaks = (np.diff(source) != 0) | (np.diff(rows.time) > longest_step)
    episode = np.concatenate([[0], np.cumsum(breaks)]).astype(np.int64)
    return Logged(Samples(joint_names, rows.time, episode, rows.q, rows.dq, rows.ddq, rows.tau), found)


def weights(times: Array, scope: Scope) -> Array | None:
    """Weight of samples of these times, Unix s: exp(−age/forgetting_s), (N,); None where nothing is forgotten."""
    if scope.forgetting_s is None or scope.newest is None:
        return None
    return np.exp(np.minimum(times - scope.newest, 0.0) / scope.forgetting_s)


def _thinned(database: Database, model: str, scope: Scope, most: int) -> tuple[list[tuple[Rows, Array]], int]:
    """Every k-th row in scope in the order of the log, each with the number of its stream, and how many there are.

    One pass, and never more than twice `most` rows in memory: k doubles whenever there are that many.
    """
    kept: list[tuple[Rows, Array]] = []
    streams: dict[str | None, int] = {}
    step, found, held, after = 1, 0, 0, 0
    while True:
        with database.session() as session:
            events = log.events(session, model, after, PAGE)
        for event in events:
            if event.number > scope.through or event.payload is None:
                continue
            rows = decode(event.payload).learnt
            rows = rows.take(rows.time >= scope.since)
            chosen = rows.take((np.arange(found, found + len(rows)) % step) == 0)
            found, held = found + len(rows), held + len(chosen)
            kept.append((chosen, np.full(len(chosen), streams.setdefault(event.stream_id, len(streams)))))
            if held > 2 * most:
                kept, step = _every(kept, 2), 2 * step
                held = sum(len(part) for part, _ in kept)
        if len(events) < PAGE or events[-1].number >= scope.through:
            break
        after = events[-1].number
    kept = [pair for pair in kept if len(pair[0])]
    if held > most:
        chosen_rows = np.zeros(held, dtype=bool)
        chosen_rows[np.linspace(0, held - 1, most).round().astype(np.int64)] = True
        kept = _where(kept, chosen_rows)
    return kept, found


def _every(parts: list[tuple[Rows, Array]], step: int) -> list[tuple[Rows, Array]]:
    return _where(parts, np.arange(sum(len(rows) for rows, _ in parts)) % step == 0)


def _where(parts: list[tuple[Rows, Array]], mask: NDArray[np.bool_]) -> list[tuple[Rows, Array]]:
    """Rows of all parts together where the mask is set."""
    out, at = [], 0
    for rows, stream in parts:
        chosen = mask[at : at + len(rows)]
        at += len(rows)
        out.append((rows.take(chosen), stream[chosen]))
    return out

"""The scale of intervals along a model's log: followed batch by batch, and taken up again from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from lipcore.data.samples import Array
from lipcore.online.adaptive import Adaptive, outside
from service.learning import owner
from service.learning.ingest.screening import Seen
from service.models.scales import Factor
from service.storage.database import EventRow

MOST_EVENTS = 3000
"""Of the log's newest, among which the last batch of a stream is looked for."""


@dataclass(frozen=True)
class Known:
    """The scale of a stream after its last batch, which a version predicted and which came at `received`, Unix s;
    doubted: see `Factor`."""

    state: Adaptive
    version: int
    received: float
    doubted: bool = False


@dataclass(frozen=True)
class HeldIntervals:
    """What intervals of promised 95 %, as answered, held: `inside`, (n,), of `rows` measurements. They add."""

    rows: int
    inside: Array

    @staticmethod
    def none(n: int) -> HeldIntervals:
        """Of no rows of n joints."""
        return HeldIntervals(0, np.zeros(n))

    def __add__(self, other: HeldIntervals) -> HeldIntervals:
        return HeldIntervals(self.rows + other.rows, self.inside + other.inside)

    def coverage(self) -> list[float | None]:
        """Share of measurements inside, per joint; None without rows."""
        return [number / self.rows if self.rows else None for number in self.inside.tolist()]


def follow(state: Adaptive, seen: Seen) -> dict[str, Any]:
    """What the report of a batch says of its stream's scale after it, and of what intervals held.

    Every measurement counts: those of contacts, of rows that wait for a decision, and of rows at rest.
    """
    factor = state.factor if seen.factor is None else seen.factor
    rows, missed = len(seen.score), outside(seen.score, factor).sum(axis=0)
    return {
        "scale": state.step(seen.time, seen.score, factor).to_json(),
        "answered": {"rows": rows, "inside": (rows - missed).tolist()},
    }


def held(report: Mapping[str, Any]) -> HeldIntervals | None:
    """What the report of a batch says that intervals held; None where it says nothing."""
    values = report.get("answered")
    return None if values is None else HeldIntervals(values["rows"], np.array(values["inside"], np.float64))


def known(event: EventRow) -> Known | None:
    """What a batch of the log says of its stream's scale; None where it was switched off or logged by an earlier
    release."""
    values = (event.report or {}).get("scale")
    if values is None or event.version is None:
        return None
    doubted = bool((event.report or {}).get("doubted"))
    return Known(Adaptive.from_json(values), event.version, event.received, doubted)


def restored(session: Session, model: str) -> dict[str, Known]:
    """The scales of a model's streams, by the last batch of each; none where its owner has switched them off."""
    if not owner.options(session, model).adaptive_intervals:
        return {}
    batches = (EventRow.model == model, EventRow.kind == "batch")
    newest = select(func.max(EventRow.number)).where(*batches).scalar_subquery()
    last = select(func.max(EventRow.number)).where(*batches, EventRow.number > newest - MOST_EVENTS)
    query = select(EventRow).where(*batches, EventRow.number.in_(last.group_by(EventRow.stream_id)))
    events = session.scalars(query.order_by(EventRow.number))
    return {event.stream_id: scale for event in events if event.stream_id and (scale := known(event)) is not None}


def factors(scales: Mapping[str, Known], version: int) -> dict[str, Factor]:
    """Those that a version answers with: of streams whose last batch it predicted."""
    return {
        stream: Factor(each.state.factor, each.received, each.doubted)
        for stream, each in scales.items()
        if each.version == version
    }

"""What a log says, by the definition: one event after the other, from the beginning, on lists in memory."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lipcore import TorqueModel
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from service.journal.log import decode
from service.storage.database import EventRow


class Fold:
    """The states of a version that contains the events up to `start` by training. events: all, from number 1 on."""

    def __init__(self, base: TorqueModel, events: Sequence[EventRow], start: int = 0) -> None:
        self.base, self.start, self.events = base, start, events
        self._known: dict[int, OnlineModel] = {}

    def after(self, number: int) -> OnlineModel:
        """The state after an event: what is left of the log up to it, learnt in order."""
        if number not in self._known:
            self._known[number] = self._begun() if number <= self.start else self._after(self.events[number - 1])
        return self._known[number]

    def _begun(self) -> OnlineModel:
        online = OnlineModel.start(self.base)
        for event in self.events[: self.start]:
            online = _remembering(online, event.detail) if event.kind == "settings" and not event.void else online
        return online

    def _after(self, event: EventRow) -> OnlineModel:
        online, detail = self.after(event.number - 1), event.detail or {}
        if event.void or event.kind in ("unlearn", "rollback"):
            return online
        if event.kind == "change":
            return online.change(event.clock + min(detail["t"] - event.received, 1.0))
        if event.kind == "settings":
            return _remembering(online, detail)
        online = online.begin(event.clock) if event.kind == "batch" else online
        return online.learn(_rows(event))


def _remembering(online: OnlineModel, detail: Any) -> OnlineModel:
    return online.with_forgetting(detail.get("forgetting_s")).with_walk(detail.get("friction_walk_s"))


def _rows(event: EventRow) -> Rows:
    """The rows of an event by the model's clock."""
    rows = decode(event.payload)
    late = np.minimum(rows.time - event.received, 1.0)
    return rows if event.kind == "replay" else replace(rows, time=event.clock + late)

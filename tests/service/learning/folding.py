"""Reference implementation of learning from a log: one event after the other, in memory."""

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
    """States of a version that was trained on the events up to `start`; `events` are all events from number 1 on."""

    def __init__(self, base: TorqueModel, events: Sequence[EventRow], start: int = 0) -> None:
        self.base, self.start, self.events = base, start, events
        self._states: dict[int, OnlineModel] = {}

    def after(self, number: int) -> OnlineModel:
        """Return the state after an event: the events up to it that are in force, learnt in order."""
        if number not in self._states:
            self._states[number] = (
                self._start_online() if number <= self.start else self._after(self.events[number - 1])
            )
        return self._states[number]

    def _start_online(self) -> OnlineModel:
        online = OnlineModel.start(self.base)
        for event in self.events[: self.start]:
            online = _with_memory(online, event.detail) if event.kind == "settings" and not event.void else online
        return online

    def _after(self, event: EventRow) -> OnlineModel:
        online, detail = self.after(event.number - 1), event.detail or {}
        if event.void or event.kind in ("unlearn", "rollback"):
            return online
        if event.kind == "change":
            return online.change(event.clock + min(detail["t"] - event.received, 1.0))
        if event.kind == "settings":
            return _with_memory(online, detail)
        online = online.begin(event.clock) if event.kind == "batch" else online
        return online.learn(_rows(event))


def _with_memory(online: OnlineModel, detail: Any) -> OnlineModel:
    return online.with_forgetting(detail.get("forgetting_s")).with_walk(detail.get("friction_walk_s"))


def _rows(event: EventRow) -> Rows:
    """Return the rows of an event, timed by the model's clock."""
    rows = decode(event.payload)
    late = np.minimum(rows.time - event.received, 1.0)
    return rows if event.kind == "replay" else replace(rows, time=event.clock + late)

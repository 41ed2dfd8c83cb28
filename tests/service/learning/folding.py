"""What a log says, by the definition: one event after the other, from the beginning, on lists in memory."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lipcore import TorqueModel
from lipcore.online.batch import Rows
from lipcore.online.learner import ForgottenError, OnlineModel
from service.journal.log import decode
from service.storage.database import EventRow

Without = Mapping[int, int]


class Fold:
    """The states of a version that contains the events up to `start` by training. events: all, from number 1 on."""

    def __init__(self, base: TorqueModel, events: Sequence[EventRow], start: int = 0) -> None:
        self.base, self.start = base, start
        self.events = {each.number: each for each in events}
        self._known: dict[Any, OnlineModel] = {}

    def after(self, number: int, without: Without | None = None) -> OnlineModel:
        """The state after an event. without: batches left out, each up to the event of a number."""
        without = dict(without or {})
        key = (number, tuple(sorted(without.items())))
        if key not in self._known:
            self._known[key] = self._after(number, without)
        return self._known[key]

    def _after(self, number: int, without: Without) -> OnlineModel:
        if number <= self.start:
            return self._remembering(OnlineModel.start(self.base), self._settings(self.start))
        event = self.events[number]
        detail = event.detail or {}
        if event.kind == "rollback":
            to = max(detail["to"], self.start)
            online = self.after(to, without)
            taken = self._take(online, to, [self.events[each] for each in range(to + 1, number)], number, without)
            return self._remembering(taken, self._settings(detail["to"])) if detail["to"] < self.start else taken
        online = self.after(number - 1, without)
        if event.kind == "unlearn":
            return self._take(online, number - 1, [event], number, without)
        if event.kind == "change":
            return online.change(event.clock + min(detail["t"] - event.received, 1.0))
        if event.kind == "settings":
            return self._remembering(online, detail)
        online = online.begin(event.clock) if event.kind == "batch" else online
        batch = number if event.kind == "batch" else detail["event"]
        return online if without.get(batch, 0) >= number else online.learn(_rows(event))

    def _take(
        self, online: OnlineModel, through: int, events: Sequence[EventRow], end: int, without: Without
    ) -> OnlineModel:
        taken = set()
        for event in events:
            batch = (event.detail or {}).get("event", 0)
            if event.kind != "unlearn" or batch in taken or without.get(batch, 0) >= event.number:
                continue
            taken.add(batch)
            live = self._live(through)
            rows = [each for each in live if each.kind != "unlearn" and batch in (each.number, _event(each))]
            if batch <= self.start or not rows:
                continue
            try:
                if any(each.kind == "settings" and each.number > rows[0].number for each in live):
                    raise ForgottenError
                for each in rows:
                    online.check_unlearn(_rows(each))
                for each in rows:
                    online = online.unlearn(_rows(each))
            except ForgottenError:
                return self.after(end, {**without, **dict.fromkeys(self._left_out(batch, end), end)})
        return online

    def _live(self, number: int) -> list[EventRow]:
        """What is left of the log up to an event: not undone, nor unlearnt."""
        live: list[EventRow] = []
        for event in (self.events[each] for each in range(1, number + 1)):
            if event.kind == "rollback":
                to = event.detail["to"]
                kept = [each for each in live if each.number <= to]
                said = {each.detail["event"] for each in live if each.kind == "unlearn" and each.number > to}
                live = [each for each in kept if each.number not in said and _event(each) not in said]
            elif event.kind == "unlearn":
                batch = event.detail["event"]
                live = [each for each in live if batch not in (each.number, _event(each))]
                live.append(event)
            else:
                live.append(event)
        return live

    def _left_out(self, batch: int, end: int) -> set[int]:
        found, before = {batch}, set[int]()
        while found != before:
            before = found
            span = [self.events[each] for each in range(min(found) + 1, min(end, max(self.events)) + 1)]
            found = found | {_event(each) for each in span if each.kind == "unlearn" and _event(each) > self.start}
        return found

    def _settings(self, number: int) -> Any:
        settings = [each for each in self._live(number) if each.kind == "settings"]
        return settings[-1].detail if settings else {}

    @staticmethod
    def _remembering(online: OnlineModel, detail: Any) -> OnlineModel:
        return online.with_forgetting(detail.get("forgetting_s")).with_walk(detail.get("friction_walk_s"))


def _rows(event: EventRow) -> Rows:
    """The rows of an event by the model's clock."""
    rows = decode(event.payload)
    late = np.minimum(rows.time - event.received, 1.0)
    return rows if event.kind == "replay" else replace(rows, time=event.clock + late)


def _event(event: EventRow) -> int:
    return int((event.detail or {}).get("event", 0))

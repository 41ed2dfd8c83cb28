"""The learner process as the service sees it: woken and listened to. Nothing here imports numerics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from service.foundation.settings import Settings
from service.runtime.companion import Companion
from service.runtime.process import Place, training_place

if TYPE_CHECKING:  # numerics
    from service.learning.learner.publication import Message


def learner_place(settings: Settings) -> Place:
    """The place of the learner process: on the CPUs of training, before it, one thread."""
    return replace(training_place(settings), threads=1, niceness=settings.learner_niceness, policy="other")


class LearnerProcess(Companion):
    """Started when a model is woken for the first time. What a process had learnt is in the log, from which the next
    one goes on. on_message: see `Companion`."""

    def __init__(self, settings: Settings, on_message: Callable[[Message], None]) -> None:
        run = "service.learning.learner.worker", "run"
        self._models: set[str] = set()
        super().__init__("learner", learner_place(settings), settings, run, on_message, lambda: tuple(self._models))

    def wake(self, model: str) -> None:
        """Say that a model's log has grown, or that other versions of it learn. Never waits for the process."""
        self._models.add(model)
        self.give(model)

"""The learner process as the service sees it. Nothing here imports numerics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from service.foundation.settings import Settings
from service.runtime.companion import Companion
from service.runtime.process import ProcessOptions, training_process_options

if TYPE_CHECKING:  # numerics
    from service.learning.learner.publication import Message


def learner_place(settings: Settings) -> ProcessOptions:
    """Return the place of the learner process: the CPUs of training, a higher priority than training, one thread."""
    return replace(training_process_options(settings), threads=1, niceness=settings.learner_niceness, policy="other")


class LearnerProcess(Companion):
    """The learner process. It starts when a model is woken for the first time.

    A restarted process learns again from the log. on_message: see `Companion`.
    """

    def __init__(self, settings: Settings, on_message: Callable[[Message], None]) -> None:
        run = "service.learning.learner.worker", "run"
        self._models: set[str] = set()
        super().__init__("learner", learner_place(settings), settings, run, on_message, lambda: tuple(self._models))

    def wake(self, model: str) -> None:
        """Report that a model's log has grown, or that other versions of it learn. Never waits for the process."""
        self._models.add(model)
        self.queue_work(model)

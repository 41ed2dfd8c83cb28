"""The weigher process as the service sees it: given rows, listened to. Nothing here imports numerics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from service.foundation.settings import Settings
from service.runtime.companion import Companion
from service.runtime.process import Place, training_place

if TYPE_CHECKING:  # numerics
    from service.learning.weigher.messages import Message

MOST_WAITING = 20
"""Batches of a stream that wait for the process; the oldest of more are passed over, as a payload shows in new ones."""


def weigher_place(settings: Settings) -> Place:
    """The place of the weigher process: at the service's priority, one thread, anywhere."""
    return replace(training_place(settings), threads=1, niceness=0, policy="other", cpus=None)


class WeigherProcess(Companion):
    """Started with the service if a version in memory knows an arm, else with the first rows of one. epoch: how often a
    process was started, each of which knows nothing. on_message: see `Companion`."""

    def __init__(self, settings: Settings, on_message: Callable[[Message], None]) -> None:
        self.epoch = 0
        run = "service.learning.weigher.worker", "run"
        super().__init__("weigher", weigher_place(settings), settings, run, on_message, self._count)

    def _count(self) -> tuple[()]:
        self.epoch += 1
        return ()

"""The weigher process as the service sees it. Nothing here imports numerics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from service.foundation.settings import Settings
from service.runtime.companion import Companion
from service.runtime.process import ProcessOptions, training_process_options

if TYPE_CHECKING:  # numerics
    from service.learning.weigher.messages import Message

MAX_WAITING_BATCHES = 20
"""Batches of a stream that wait for the process. The oldest are dropped: new ones show the payload too."""


def weigher_place(settings: Settings) -> ProcessOptions:
    """Return the place of the weigher process: the service's priority, one thread, any CPU."""
    return replace(training_process_options(settings), threads=1, niceness=0, policy="other", cpus=None)


class WeigherProcess(Companion):
    """The weigher process.

    It starts with the service if a version in memory has an arm, else with the first rows for such a version.

    epoch: number of process starts; a new process has no streams. on_message: see `Companion`.
    """

    def __init__(self, settings: Settings, on_message: Callable[[Message], None]) -> None:
        self.epoch = 0
        run = "service.learning.weigher.worker", "run"
        super().__init__("weigher", weigher_place(settings), settings, run, on_message, self._count)

    def _count(self) -> tuple[()]:
        self.epoch += 1
        return ()

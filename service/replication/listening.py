"""A thread that hears what other services tell, for as long as the service runs, whatever the database does."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import closing

from service.storage.database import Database
from service.storage.database.engine import Notice

logger = logging.getLogger(__name__)

PAUSE_S = 0.2
"""Seconds after which it looks whether to end."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 2.0
"""Until it connects again: each time twice as long."""


class Listener:
    """heard: called with each notice; missed: called whenever it begins to hear: what was told before is not known.

    Both in a thread of its own, and never to wait in.
    """

    def __init__(self, database: Database, heard: Callable[[Notice], None], missed: Callable[[], None]) -> None:
        self._database, self._heard, self._missed = database, heard, missed
        self._ending, self._hearing = threading.Event(), False
        self._thread = threading.Thread(target=self._run, daemon=True, name="lipserve-notices")
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._ending.set()
        self._thread.join()

    def _run(self) -> None:
        pause = FIRST_PAUSE_S
        while not self._ending.is_set():
            try:
                self._listen()
            except Exception as error:  # whatever it is: there is nobody else to listen
                logger.warning("notices of other services are not heard now: %s", error)
            pause = min(2 * pause, LONGEST_PAUSE_S) if not self._hearing else FIRST_PAUSE_S
            self._ending.wait(pause)

    def _listen(self) -> None:
        self._hearing = False
        with closing(self._database.changes_of_others(PAUSE_S)) as told:
            for notice in told:
                if self._ending.is_set():
                    return
                if not self._hearing:
                    self._hearing = True
                    self._missed()
                if notice is not None and notice.origin != self._database.origin:
                    self._heard(notice)

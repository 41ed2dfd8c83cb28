"""A count of the changes of what answers, for threads that publish it."""

from __future__ import annotations

import threading


class Changes:
    """Counts changes; threads wait for the next one. Safe to share between threads.

    number: count of changes. Read it before what it counts, so that no change is missed.
    """

    def __init__(self) -> None:
        self.number = 0
        self._noted = threading.Condition()

    def note(self) -> None:
        """Count a change, which is visible to all threads by now, and wake those that wait."""
        with self._noted:
            self.number += 1
            self._noted.notify_all()

    def wait(self, seen: int, seconds: float | None = None) -> int:
        """Wait for a change after number `seen`, at most `seconds` if given; return the number."""
        with self._noted:
            self._noted.wait_for(lambda: self.number > seen, seconds)
            return self.number

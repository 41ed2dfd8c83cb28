"""Progress of a process. A suspended or deadlocked process still exists, so existence proves nothing.

A process makes progress if it reports steps, or if its main thread computes: a step may take minutes, such as the
compilation of kernels. The operating system counts CPU time, so no thread of the process has to report it. A long call
of compiled code would block such a thread. Nothing here imports numerics.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable
from pathlib import Path

HEARTBEAT_S = 60.0
"""Seconds without progress after which a computing process is killed: such a step takes seconds."""
CHECK_S = 1.0
"""Seconds between two checks. A longer gap counts as at most twice this time: the checking process may have stopped."""
TICK_S = 0.01
"""CPU time that counts as progress, s: one tick of the system. An idle wait takes far less."""


def main_thread_s(pid: int) -> float | None:
    """Return the CPU time of a process's main thread, s; None if the process ended or the system is not Linux."""
    try:
        fields = Path(f"/proc/{pid}/task/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError):
        return None


class Progress:
    """Watches one process, or several that share work. Use it from one thread; any thread may read `silent_s`.

    - pids: returns the current ids of the processes.
    - quiet_s: max time without a step and without CPU time, s.
    - step_s: max time of one step, s, even if they compute. It is the only limit if the system reports no CPU time.
    - spent: returns the CPU time of a process, s.
    - silent_s: time without progress, s.
    """

    def __init__(
        self,
        pids: Callable[[], Iterable[int]],
        quiet_s: float,
        step_s: float,
        spent: Callable[[int], float | None] = main_thread_s,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.silent_s = 0.0
        self._pids, self._quiet_s, self._step_s, self._spent, self._clock = pids, quiet_s, step_s, spent, clock
        self._stepless_s, self._looked = 0.0, clock()
        self._known: dict[int, float] = {}

    def step(self) -> None:
        """Record a step."""
        self.silent_s = self._stepless_s = 0.0

    def check(self) -> str | None:
        """Return why the processes are considered hung, None if they make progress. Call it every CHECK_S."""
        now = self._clock()
        passed, self._looked = min(now - self._looked, 2 * CHECK_S), now
        spent = {pid: each for pid in self._pids() if (each := self._spent(pid)) is not None}
        self._stepless_s += passed
        if not spent or any(each - self._known.get(pid, -TICK_S) >= TICK_S for pid, each in spent.items()):
            self.silent_s, self._known = 0.0, spent
        else:
            self.silent_s += passed
        if self.silent_s >= self._quiet_s:
            return f"it has made no progress for {self._quiet_s:g} s"
        if self._stepless_s >= self._step_s:
            return f"one of its steps has taken {self._step_s:g} s"
        return None

"""Whether a process gets on. That it is there says nothing: one that is suspended, or waits for ever, is there too.

It gets on while it takes steps, of which it tells, or while its main thread computes: a step may take minutes, as when
kernels are compiled. CPU time is the system's own figure, so that no thread of the process has to report it, which a
long call of compiled code would silence. Nothing here imports numerics.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable
from pathlib import Path

HEARTBEAT_S = 60.0
"""Seconds without progress after which a process that computes is killed: such a step takes seconds."""
LOOK_S = 1.0
"""Seconds between two looks; more than twice as many count as so many: who looks may have stood still as well."""
TICK_S = 0.01
"""CPU time that is progress, s: the system counts in such ticks. Waiting in vain takes far less."""


def main_thread_s(pid: int) -> float | None:
    """CPU time of a process's main thread, s; None where the system does not tell (Linux does), or it has ended."""
    try:
        fields = Path(f"/proc/{pid}/task/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError):
        return None


class Progress:
    """Watches one process, or several that share work. To be used by one thread; `silent_s` may be read by any.

    pids: which they are now; quiet_s: longest time without a step and without CPU time; step_s: longest that a step may
    take, however busy they are: the only limit where the system does not tell of CPU time.
    silent_s: seconds for which they have not got on.
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
        """Take note of a step."""
        self.silent_s = self._stepless_s = 0.0

    def look(self) -> str | None:
        """Say why they have to be taken for hung, in words, None while they get on; to be asked every LOOK_S."""
        now = self._clock()
        passed, self._looked = min(now - self._looked, 2 * LOOK_S), now
        spent = {pid: each for pid in self._pids() if (each := self._spent(pid)) is not None}
        self._stepless_s += passed
        if not spent or any(each - self._known.get(pid, -TICK_S) >= TICK_S for pid, each in spent.items()):
            self.silent_s, self._known = 0.0, spent
        else:
            self.silent_s += passed
        if self.silent_s >= self._quiet_s:
            return f"it has not got on for {self._quiet_s:g} s"
        if self._stepless_s >= self._step_s:
            return f"one step of it has taken {self._step_s:g} s"
        return None

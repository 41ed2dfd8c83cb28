"""The parent of both planes: it forks their processes, and restarts those that end or hang.

It has no threads and answers nothing. Its children end with it.
"""

from __future__ import annotations

import logging
import os
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from service.planes.pulse import Plane, Pulse, Watch
from service.runtime import forking

logger = logging.getLogger(__name__)
POLL_S = 0.1
"""Seconds between two looks at the heartbeats."""
MAX_SILENT_S = {Plane.DATA: 0.5, Plane.CONTROL: 60.0}
"""Seconds without a heartbeat after which a plane is killed. The data plane goes on if the control plane hangs."""
WARNING_S = 5.0
"""Seconds without a heartbeat after which the log mentions the control plane."""
MIN_PAUSE_S, MAX_PAUSE_S = 0.1, 10.0
"""Pause before the second restart of a process, doubled each time, and its max. The first restart is at once."""
MIN_LIFE_S = 30.0
"""A process that lived this long starts again without a pause."""
MAX_ORPHAN_S = 2.0
"""Max wait of a new control plane for the end of the processes that its predecessor started, s."""
STOPS = (signal.SIGTERM, signal.SIGINT)


@dataclass
class Child:
    """A process of a plane, and when it is due to start."""

    plane: Plane
    work: Callable[[], None]
    name: str
    pid: int | None = None
    began: float = -float("inf")
    due: float = 0.0
    pause_s: float = 0.0

    def start(self) -> None:
        """Fork it; try again later if the system refuses."""
        try:
            self.pid, self.began = forking.fork(self.work, self.name), time.monotonic()
        except OSError as error:
            logger.error("the %s process could not be started: %s", self.name, error)
            self.put_off()

    def put_off(self) -> None:
        """Choose when it starts again."""
        now = time.monotonic()
        self.pause_s = 0.0 if now - self.began >= MIN_LIFE_S else self.pause_s
        self.pid, self.due = None, now + self.pause_s
        self.pause_s = min(max(MIN_PAUSE_S, 2 * self.pause_s), MAX_PAUSE_S)


class Supervisor:
    """Starts processes, restarts those that end or hang, and stops them in order.

    when_stopping: called when the stop begins.
    """

    def __init__(self, children: Sequence[Child], pulse: Pulse, when_stopping: Callable[[], None]) -> None:
        self.children, self.pulse, self._when_stopping = children, pulse, when_stopping
        self._watches = [Watch(pulse, plane, most) for plane, most in MAX_SILENT_S.items()]
        self._warning = Watch(pulse, Plane.CONTROL, WARNING_S)
        self._ending: int | None = None
        self._last_stop = False

    def run(self) -> int:
        """Return the exit code: that of a failed start, 0 after Ctrl-C, negative if a signal shall end this process."""
        awaited = {signal.SIGCHLD, *STOPS}
        signal.pthread_sigmask(signal.SIG_BLOCK, awaited)
        signal.signal(signal.SIGUSR1, signal.SIG_IGN)  # a control plane may get it before it has a handler
        while True:
            if self._ending is None:
                self._start_due()
            caught = signal.sigtimedwait(awaited, POLL_S)
            if caught is not None and caught.si_signo in STOPS:
                if self._ending is not None:
                    self._send(signal.SIGKILL, *Plane)
                    return -caught.si_signo
                self._stop(0 if caught.si_signo == signal.SIGINT else -caught.si_signo)
            self._reap()
            if self._ending is None:
                self._check_beats()
            elif self._finish():
                return self._ending

    def _start_due(self) -> None:
        now, pids = time.monotonic(), {child.pid for child in self.children}
        for child in self.children:
            if child.pid is not None or now < child.due:
                continue
            # what an earlier control plane has started must not work beside the new one's
            orphaned = child.plane == Plane.CONTROL and now < child.due + MAX_ORPHAN_S and forking.kill_orphans(pids)
            if not orphaned:
                child.start()

    def _stop(self, ending: int) -> None:
        """Begin to stop, first the data plane: the control plane logs its last frames."""
        self._ending = ending
        self._when_stopping()
        self._send(signal.SIGUSR1, Plane.CONTROL)  # it reports that the service stops
        self._send(signal.SIGTERM, Plane.DATA)

    def _finish(self) -> bool:
        """Stop the control plane after the data plane; return whether all processes have ended."""
        running = {child.plane for child in self.children if child.pid is not None}
        if running == {Plane.CONTROL} and not self._last_stop:
            self._last_stop = True
            self._send(signal.SIGTERM, Plane.CONTROL)
        return not running

    def _reap(self) -> None:
        with suppress(ChildProcessError):
            while (ended := os.waitpid(-1, os.WNOHANG))[0]:
                for child in self.children:
                    if child.pid == ended[0]:
                        self._handle_end(child, os.waitstatus_to_exitcode(ended[1]))

    def _handle_end(self, child: Child, code: int) -> None:
        """Let a process that has ended start again, or stop the service if that has not started yet."""
        pid, name = child.pid, child.plane.name.lower()
        child.put_off()
        if self._ending is not None:
            return
        if not self.pulse.last_beat(Plane.DATA).pid:
            logger.error("the %s plane ended with exit code %d before the service had started", name, code)
            self._stop(code if code > 0 else forking.FAILED)
            return
        logger.error("process %s of the %s plane ended with exit code %d; it is started again", pid, name, code)
        self.pulse.record_restart(child.plane)
        for watch in (*self._watches, self._warning):
            watch.restart()

    def _check_beats(self) -> None:
        pids = [child.pid for child in self.children]
        if (silence := self._warning.silent()) is not None:
            logger.error(
                "the control plane has not answered for %.0f s: queries are answered, but nothing is learnt", silence[1]
            )
            self._warning.restart()
        for watch in self._watches:
            if (silence := watch.silent()) is None or silence[0] not in pids:
                continue
            name = watch.plane.name.lower()
            logger.error("the %s plane hangs and is killed: no heartbeat for %.1f s", name, silence[1])
            watch.restart()
            os.kill(silence[0], signal.SIGKILL)

    def _send(self, number: int, *planes: Plane) -> None:
        for child in self.children:
            if child.pid is not None and child.plane in planes:
                os.kill(child.pid, number)

"""A process beside the service: it receives work, sends messages, and is restarted if it ends or hangs.

Nothing here imports numerics: the process sets its options before it does, see `service.runtime.process`.
"""

from __future__ import annotations

import logging
import multiprocessing
import signal
import threading
import time
from collections.abc import Callable, Hashable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from service.foundation.settings import Settings
from service.runtime import nursery
from service.runtime.nursery import Forked
from service.runtime.process import ProcessOptions, call, start_process
from service.runtime.progress import CHECK_S, Progress

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class CompanionOptions:
    """Times of restart and replacement."""

    pause_s: float = 0.5
    """Seconds until an ended process is restarted; doubled each time."""
    max_pause_s: float = 30.0
    """Max of these seconds. A process that lived this long starts again at `pause_s`."""
    quiet_s: float = 45.0
    """Seconds without a finished step and without computation, after which the process is replaced."""
    step_s: float = 900.0
    """Max seconds of one step, after which the process is replaced."""


COMPANION = CompanionOptions()

BEAT, BEAT_S = "beat", 1.0
"""Message of the process after a step, and the min seconds between two of them."""
Work = dict[Hashable, list[Any]]
"""Items of work of each subject, in the order in which they are processed."""


class Companion:
    """A process that starts with its first work and ends with the service.

    - name: for people.
    - place: share of the machine.
    - run: module and function that the process runs, with the settings and a connection. It receives `Work`, and None
      at the end.
    - on_message: called with each message in order, in a thread of its own.
    - at_start: returns the subjects of the first work of each new process.
    """

    def __init__(
        self,
        name: str,
        place: ProcessOptions,
        settings: Settings,
        run: tuple[str, str],
        on_message: Callable[[Any], None],
        at_start: Callable[[], Iterable[Hashable]] = tuple,
    ) -> None:
        self.name, self.place, self.settings = name, place, settings
        self.on_message, self._run, self._at_start = on_message, run, at_start
        self._changed = threading.Condition()
        self._work: Work = {}
        self._connection: Connection | None = None
        self._process: BaseProcess | Forked | None = None
        self._progress: Progress | None = None
        self._threads: list[threading.Thread] = []
        self._closing = False

    @property
    def pid(self) -> int | None:
        """Id of the process, None if there is none."""
        process = self._process
        return None if process is None or not process.is_alive() else process.pid

    @property
    def silent_s(self) -> float:
        """Seconds without progress of the process; 0 if it makes progress or does not run."""
        progress = self._progress
        return 0.0 if progress is None else progress.silent_s

    @property
    def is_needed(self) -> bool:
        """Return whether there should be a process: it has received work, and the service is not closing."""
        return bool(self._threads) and not self._closing

    def queue_work(self, about: Hashable, *items: Any, most: int | None = None) -> int:
        """Queue work for the process without waiting; return the number of dropped items.

        most: max items that wait; the oldest are dropped.
        """
        with self._changed:
            if self._closing:
                return 0
            waiting = self._work.setdefault(about, [])
            waiting += items
            dropped = 0 if most is None else max(0, len(waiting) - most)
            del waiting[:dropped]
            if not self._threads:
                self._threads = [threading.Thread(target=each, daemon=True) for each in (self._supervise, self._send)]
                for thread in self._threads:
                    thread.start()
            self._changed.notify_all()
            return dropped

    def close(self) -> None:
        """End the process; kill it after 5 s."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if not self._threads:
            return
        supervisor, sender = self._threads
        supervisor.join(5.0)
        if supervisor.is_alive() and self._process is not None:
            logger.warning("the %s process does not end; it is killed", self.name)
            self._process.kill()
        supervisor.join()
        sender.join()

    def _supervise(self) -> None:
        pause = COMPANION.pause_s
        while not self._closing:
            began = time.monotonic()
            try:
                connection, self._process = self._start()
            except Exception:  # no memory or too many processes: a retry may succeed
                logger.exception("the %s process could not be started; retrying", self.name)
                pause = self._rest(pause)
                continue
            with self._changed:
                self._connection = connection
                for each in self._at_start():
                    self._work.setdefault(each, [])
                self._changed.notify_all()
                if self._closing:  # closed during the start: the sender has ended already
                    self._process.kill()
            self._listen(connection, self._process)
            self._process.join()
            with self._changed:
                self._connection = self._progress = None
                if self._closing:
                    return
                pause = COMPANION.pause_s if time.monotonic() - began >= COMPANION.max_pause_s else pause
                code = self._process.exitcode
                logger.error("the %s process ended with exit code %s; it is started again", self.name, code)
            pause = self._rest(pause)

    def _rest(self, pause: float) -> float:
        """Wait before the next start; return the wait before the one after that."""
        with self._changed:
            self._changed.wait_for(lambda: self._closing, pause)
        return min(2 * pause, COMPANION.max_pause_s)

    def _start(self) -> tuple[Connection, BaseProcess | Forked]:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        given = self.place, self._run, self.settings
        with theirs:  # the process has its own copy: an open copy here would hide its end
            if (forked := self._fork(theirs, *given)) is not None:
                return ours, forked
            name = f"lipserve-{self.name}"
            process = context.Process(target=_begin, args=(*given, theirs), daemon=True, name=name)
            process.start()
            return ours, process

    def _fork(self, theirs: Connection, *given: Any) -> Forked | None:
        """Return a process that shares the imports of this one; None if there is no nursery."""
        if (forks := nursery.current()) is None:
            return None
        try:
            return forks.start(self.name, self.place, theirs, _begin, *given)
        except OSError as error:
            logger.warning("the %s process is started as a new interpreter: %s", self.name, error)
            return None

    def _listen(self, connection: Connection, process: BaseProcess | Forked) -> None:
        """Pass on the messages of the process until it ends; kill it if it hangs."""
        pids = () if process.pid is None else (process.pid,)
        progress = self._progress = Progress(lambda: pids, COMPANION.quiet_s, COMPANION.step_s)
        while True:
            try:
                message = connection.recv() if connection.poll(min(CHECK_S, COMPANION.quiet_s / 4)) else None
            except (EOFError, OSError):
                return
            if message is None:
                if (reason := progress.check()) is not None and process.is_alive():
                    logger.error("the %s process hangs and is killed: %s", self.name, reason)
                    process.kill()
                    return
                continue
            progress.step()
            if message == BEAT:
                continue
            try:
                self.on_message(message)
            except Exception:  # the next one may be valid
                logger.exception("could not handle a message of the %s process: %s", self.name, message)

    def _send(self) -> None:
        """Send work, in a thread: the process may be busy and the pipe full."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closing or (self._connection is not None and self._work))
                connection, closing = self._connection, self._closing
                work, self._work = self._work, {}
            if connection is not None:
                with suppress(OSError):  # the process has ended
                    connection.send(None if closing else work)
            if closing:
                return


def receive_work(connection: Connection, seconds: float) -> Work | None:
    """Return the work that arrives within `seconds`; None if the process has to end. Called in the companion process.

    Raise EOFError or ConnectionError if the service is gone.
    """
    work: Work = {}
    while connection.poll(seconds):
        given = connection.recv()
        if given is None:
            return None
        for about, items in given.items():
            work.setdefault(about, []).extend(items)
        seconds = 0.0
    return work


def _begin(place: ProcessOptions, run: tuple[str, str], settings: Settings, connection: Connection) -> None:
    start_process(place)
    # a signal to all processes ends the parent in order, which then ends this one
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    call(*run, settings, connection)  # imports numerics, see the module's docstring

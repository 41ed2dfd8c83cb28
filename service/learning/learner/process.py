"""The learner process as the service sees it: woken, listened to, and started again when it dies or hangs.

Nothing here imports numerics: the process takes its place on the machine before it does, see `training.process`.
"""

from __future__ import annotations

import logging
import multiprocessing
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import TYPE_CHECKING

from service.compute.process import Place, call, start_process, training_place
from service.compute.progress import LOOK_S, Progress
from service.foundation.settings import Settings

if TYPE_CHECKING:  # numerics, see above
    from service.learning.learner.publication import Message

logger = logging.getLogger(__name__)

FIRST_PAUSE, LONGEST_PAUSE = 0.5, 30.0
"""Seconds until a process that died is started again: each time twice as long, unless it lived for LONGEST_PAUSE."""
END_SECONDS = 5.0
"""Longest wait for the process to store what it has learnt and end."""
BEAT, BEAT_S = "beat", 1.0
"""What the process says after a step, and how often it says so at most, s."""


def learner_place(settings: Settings) -> Place:
    """The place of the learner process: on the CPUs of training, before it, one thread."""
    return replace(training_place(settings), threads=1, niceness=settings.learner_niceness, policy="other")


class LearnerProcess:
    """Started when a model is woken for the first time. on_message: called in a thread of its own, with one message
    after the other, in the order in which they were sent."""

    def __init__(self, settings: Settings, on_message: Callable[[Message], None]) -> None:
        self.settings, self.on_message = settings, on_message
        self._changed = threading.Condition()
        self._waiting: set[str] = set()
        self._models: set[str] = set()
        self._connection: Connection | None = None
        self._process: BaseProcess | None = None
        self._progress: Progress | None = None
        self._threads: list[threading.Thread] = []
        self._closing = False

    @property
    def pid(self) -> int | None:
        """Id of the process, None while there is none."""
        process = self._process
        return None if process is None or not process.is_alive() else process.pid

    @property
    def silent_s(self) -> float:
        """Seconds for which the process has not got on; 0 while it does, or there is none."""
        progress = self._progress
        return 0.0 if progress is None else progress.silent_s

    @property
    def needed(self) -> bool:
        """Whether there should be a process: a model has been woken, and the service is not closing."""
        return bool(self._threads) and not self._closing

    def wake(self, model: str) -> None:
        """Say that a model's log has grown, or that other versions of it learn. Never waits for the process."""
        with self._changed:
            if self._closing:
                return
            self._models.add(model)
            self._waiting.add(model)
            if not self._threads:
                self._threads = [threading.Thread(target=each, daemon=True) for each in (self._supervise, self._send)]
                for thread in self._threads:
                    thread.start()
            self._changed.notify_all()

    def close(self) -> None:
        """Let the process store what it has learnt and end; end it where that takes too long."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if not self._threads:
            return
        supervisor, sender = self._threads
        supervisor.join(END_SECONDS)
        if supervisor.is_alive() and self._process is not None:
            logger.warning("the learner process does not end: killed")
            self._process.kill()
        supervisor.join()
        sender.join()

    def _supervise(self) -> None:
        pause = FIRST_PAUSE
        while not self._closing:
            began = time.monotonic()
            try:
                connection, self._process = self._start()
            except Exception:  # no memory, too many processes: another time there may be
                logger.exception("the learner process cannot be started: tried again")
                pause = self._rest(pause)
                continue
            with self._changed:
                self._connection = connection
                self._waiting |= self._models
                self._changed.notify_all()
                if self._closing:  # while it was started: the sender has gone already
                    self._process.kill()
            self._listen(connection, self._process)
            self._process.join()
            with self._changed:
                self._connection = self._progress = None
                if self._closing:
                    return
                pause = FIRST_PAUSE if time.monotonic() - began >= LONGEST_PAUSE else pause
                logger.error("the learner process ended with exit code %s; it is started again", self._process.exitcode)
            pause = self._rest(pause)

    def _rest(self, pause: float) -> float:
        """Wait before the next start; return how long to wait before the one after that."""
        with self._changed:
            self._changed.wait_for(lambda: self._closing, pause)
        return min(2 * pause, LONGEST_PAUSE)

    def _start(self) -> tuple[Connection, BaseProcess]:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        arguments = learner_place(self.settings), self.settings, theirs
        process = context.Process(target=_learn, args=arguments, daemon=True, name="lipserve-learner")
        process.start()
        theirs.close()  # the process has its own: with this one open, its end would go unnoticed
        return ours, process

    def _listen(self, connection: Connection, process: BaseProcess) -> None:
        """Hand on the messages of the process, until it has ended; end it where it does not get on. What it had learnt
        is in the log, from which the next one goes on."""
        pids = () if process.pid is None else (process.pid,)
        quiet_s, step_s = self.settings.learner_heartbeat_s, self.settings.learner_step_s
        progress = self._progress = Progress(lambda: pids, quiet_s, step_s)
        while True:
            try:
                message = connection.recv() if connection.poll(min(LOOK_S, quiet_s / 4)) else None
            except (EOFError, OSError):
                return
            if message is None:
                if (reason := progress.look()) is not None and process.is_alive():
                    logger.error("the learner process hangs and is killed: %s", reason)
                    process.kill()
                    return
                continue
            progress.step()
            if message == BEAT:
                continue
            try:
                self.on_message(message)
            except Exception:  # the next one may be right
                logger.exception("a message of the learner process was not taken: %s", message)

    def _send(self) -> None:
        """Name the models to the process: in a thread, because it may be busy and the pipe full."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closing or (self._connection is not None and self._waiting))
                connection, closing = self._connection, self._closing
                models, self._waiting = self._waiting, set()
            if connection is not None:
                with suppress(OSError):  # it has died: all models are named to the next one
                    connection.send(None if closing else models)
            if closing:
                return


def _learn(place: Place, settings: Settings, connection: Connection) -> None:
    start_process(place)
    # a signal to all processes of the service ends the parent in order, which then lets this one store its state
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    call("service.learning.learner.worker", "run", settings, connection)  # numerics, see above

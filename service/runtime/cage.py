"""Functions that read strangers' files, called in a process that can do nothing else: see `confinement`.

A process that has imported the readers waits for calls, and is forked ahead of each: see `reader_process`. What goes
there are names, paths and plain values; what comes back is data of a type that the caller names, checked against it.
Nothing is unpickled. A process that crashes, hangs or takes too much costs its own call an answer of 422 or 413, and
nobody else anything.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from lipcore.extras import MissingExtraError
from service.foundation.errors import NotReadyError, ServiceError, TooLargeError, invalid_data, problem, readable
from service.foundation.settings import Settings
from service.runtime.confinement import OPEN_FILES
from service.runtime.progress import LOOK_S, Progress
from service.runtime.reader_messages import (
    ERRORS,
    OUTPUT_BYTES,
    Answer,
    Call,
    Failure,
    Outcome,
    plain,
    receive,
    send,
    typed,
)

logger = logging.getLogger(__name__)
T = TypeVar("T")

IMPORT_S = 120.0
"""Longest wait in s for a process that is yet to be started, to import a reader or to answer, on a busy machine."""
ENVIRONMENT = {
    "LANG": "C.UTF-8",
    "OPENBLAS_NUM_THREADS": "1",  # a thread that runs when a process is forked is not in the fork
    "OMP_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "2",  # each takes address space, used or not
    "ARROW_DEFAULT_MEMORY_POOL": "system",
}
CPU_SHARE = 0.5
"""Processor time that reading one upload may take, in shares of its time."""
_making = threading.Lock()


class UnexpectedReaderError(RuntimeError):
    """A reader failed with an error that it should not have, which the log shows."""


def run(
    function: str,
    returns: type[T],
    *arguments: Any,
    settings: Settings,
    folder: Path | None = None,
    field: str = "file",
) -> T:
    """Call `module:function` in a confined process; return what it does, of the type `returns`. Not for the event loop.

    function: its module is imported before the process is forked, and what that has to do first is done by a function
    `warm` of it; arguments: plain values, data classes of such, paths, small arrays, settings (of which what readers
    need goes); folder: may be written, paths among the arguments be read; field: what errors call the file. Raise what
    the function raises of `ERRORS`, MissingExtraError and OSError; InvalidDataError where it reached a limit or
    crashed, TooLargeError where that is one of size; UnexpectedReaderError for any other error of the function.
    """
    limits = settings.parser_memory_bytes, cpu_s(settings), settings.parser_s, settings.max_unpacked_bytes
    paths = [os.fspath(each) for each in arguments if isinstance(each, Path)]
    write = [] if folder is None else [os.fspath(folder)]
    encoded = msgspec.Raw(msgspec.msgpack.encode(arguments, enc_hook=plain))
    outcome = _ask(Call(function, encoded, paths, write, *limits))
    if outcome.output:
        shown = readable(outcome.output.decode(errors="backslashreplace"))[:OUTPUT_BYTES]
        logger.warning("a reader of an upload wrote", extra={"fields": {"reader": function, "output": shown}})
    if outcome.late:
        raise _beyond("time", field, settings)
    if outcome.status == -signal.SIGXCPU:
        raise _beyond("processor", field, settings)
    try:
        answer = _decoder(Answer).decode(outcome.answer)
        if answer.failure is not None:
            raise _error(answer.failure, function, field, settings)
        if outcome.status == 0:
            return _decoder(returns).decode(answer.value)
    except msgspec.MsgspecError as error:
        logger.warning("a reader of an upload sent what is no answer: %s", error)
    raise invalid_data(field, f"one that cannot be read: its reader {_ending(outcome.status)}", "an undamaged one")


def _decoder(kind: type[T]) -> msgspec.msgpack.Decoder[T]:
    """Made by one thread at a time: two that are the first to use a type of msgspec at once can end the process."""
    with _making:
        return msgspec.msgpack.Decoder(kind, dec_hook=typed)


def _ask(call: Call) -> Outcome:
    data = msgspec.msgpack.encode(call)
    for _ in range(2):
        try:
            connection, process = _spawner.connect()
            with connection:
                _hand_over(call, connection, process)
                connection.settimeout(call.wall_s + IMPORT_S)
                send(connection, data)
                return _decoder(Outcome).decode(receive(connection))
        # the process that waits for calls had just ended, or hangs, or none can be started
        except (EOFError, OSError) as error:
            failed = error
    raise NotReadyError(f"uploads cannot be read now: no process can be started for it ({failed!r})")


def _hand_over(call: Call, connection: socket.socket, process: Any) -> None:
    """Name the function of a call and wait until a process has it; raise TimeoutError where the one that waits for
    calls hangs, once that has been ended."""
    progress = Progress(lambda: [process.pid], call.wall_s, IMPORT_S)
    connection.settimeout(LOOK_S)
    send(connection, call.function.encode())
    while True:
        try:
            if connection.recv(1):
                return
            raise EOFError
        except TimeoutError:
            if (reason := progress.look()) is not None:
                logger.error("the process that waits for uploads hangs and is killed: %s", reason)
                _spawner.end(process)
                raise


def cpu_s(settings: Settings) -> int:
    """Processor time in s that reading one upload may take."""
    return max(1, round(CPU_SHARE * settings.parser_s))


def _beyond(limit: str, field: str, settings: Settings) -> ServiceError:
    """The error of a file that takes more than a limit."""
    of = {
        "memory": ("memory", f"{settings.parser_memory_bytes} bytes", "LIPSERVE_PARSER_MEMORY_BYTES"),
        "processor": ("processor time", f"{cpu_s(settings)} s", "LIPSERVE_PARSER_S"),
        "time": ("time", f"{settings.parser_s:g} s", "LIPSERVE_PARSER_S"),
        "files": ("open files", f"{OPEN_FILES}", None),
        "size": ("space", f"{settings.max_unpacked_bytes} bytes", "LIPSERVE_MAX_UNPACKED_BYTES"),
    }
    what, most, setting = of[limit]
    expected = f"at most {most}" + ("" if setting is None else f" ({setting} sets it)")
    error = invalid_data(field, f"one that takes more than {most} of {what} to read", expected)
    return TooLargeError(error.message, error.detail) if limit == "size" else error


def _error(failure: Failure, function: str, field: str, settings: Settings) -> Exception:
    if failure.code == "limit":
        return _beyond(failure.message, field, settings)
    if failure.code == "extra":
        extra, lacking, reason = failure.detail[0]
        return MissingExtraError(extra, str(lacking), reason or None)
    if failure.code == "system":
        return OSError(failure.number, os.strerror(failure.number))
    if failure.code in ERRORS:
        items = [problem(where, value, expected) for where, value, expected in failure.detail]
        return ERRORS[failure.code](readable(failure.message), items)
    return UnexpectedReaderError(f"{function}: {readable(failure.message)}")


def _ending(status: int) -> str:
    if status >= 0:
        return f"ended with exit code {status}"
    with suppress(ValueError):
        return f"was ended by {signal.Signals(-status).name}"
    return f"was ended by signal {-status}"


class _Spawner:
    """The process of this one that waits for calls; started when it is needed."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._control: socket.socket | None = None
        self._process: Any = None
        self._owner = 0

    def connect(self) -> tuple[socket.socket, Any]:
        """A connection for one call, and the process that it goes to; raise OSError where none can be started."""
        ours, theirs = socket.socketpair()
        with theirs, self._lock:
            control = self._control if self._owner == os.getpid() else None  # a forked process starts its own
            try:
                if control is None:
                    raise ConnectionError
                socket.send_fds(control, [b"c"], [theirs.fileno()])
            except ConnectionError:  # it has ended, as it does when nobody calls
                socket.send_fds(self._start(), [b"c"], [theirs.fileno()])
            return ours, self._process

    def end(self, process: Any) -> None:
        """End a process, and start another one for the next call."""
        with self._lock:
            if process is self._process and self._control is not None:
                process.kill()
                self._control.close()
                self._control = None

    def _start(self) -> socket.socket:
        self._owner = os.getpid()
        self._control, theirs = socket.socketpair()
        with theirs:
            self._process = start(theirs)
        return self._control


def start(control: socket.socket) -> Any:
    """Start a process that serves the calls of a socket, with no descriptor and no variable but what it needs."""
    path = json.dumps([os.path.abspath(each) for each in sys.path])
    code = (
        "import json, sys; sys.path[:] = json.loads(sys.argv[1]); from service.runtime import reader_process as process"
    )
    return subprocess.Popen(  # noqa: S603 - our own
        [sys.executable, "-I", "-c", f"{code}; process.serve({control.fileno()})", path],
        pass_fds=[control.fileno()],
        stdin=subprocess.DEVNULL,
        env=ENVIRONMENT
        | {name: os.environ[name] for name in ("LD_LIBRARY_PATH", "NUMBA_CACHE_DIR", "TZ") if name in os.environ},
        cwd="/",
        start_new_session=True,  # Ctrl-C is not for it
    )


_spawner = _Spawner()

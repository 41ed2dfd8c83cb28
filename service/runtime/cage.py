"""Calls of functions that read untrusted files, each in a confined process: see `confinement`.

A process that has imported the readers waits for calls and forks a process ahead of each: see `reader_process`. It
receives names, paths and plain values; it returns data of a type that the caller names, and they are checked. Nothing
is unpickled. A process that crashes, hangs or exceeds a limit fails only its own call, with 422 or 413.
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
from service.runtime.confinement import MAX_OPEN_FILES
from service.runtime.progress import CHECK_S, Progress
from service.runtime.reader_messages import (
    ERRORS,
    MAX_OUTPUT_BYTES,
    Answer,
    Call,
    Failure,
    Outcome,
    from_plain,
    receive,
    send,
    to_plain,
)

logger = logging.getLogger(__name__)
T = TypeVar("T")

IMPORT_S = 120.0
"""Max wait for a process to start, import a reader or answer, s, on a busy machine."""
ENVIRONMENT = {
    "LANG": "C.UTF-8",
    "OPENBLAS_NUM_THREADS": "1",  # a running thread is not copied by a fork
    "OMP_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "2",  # each uses address space, even if empty
    "ARROW_DEFAULT_MEMORY_POOL": "system",
}
CPU_SHARE = 0.5
"""Max processor time of one upload's reader, as a share of its max time."""
_making = threading.Lock()


class UnexpectedReaderError(RuntimeError):
    """A reader failed with an unexpected error; the log shows it."""


def run(
    function: str,
    returns: type[T],
    *arguments: Any,
    settings: Settings,
    folder: Path | None = None,
    field: str = "file",
) -> T:
    """Call `module:function` in a confined process; return its result as the type `returns`.

    Blocking: use it in a thread.

    - function: its module is imported before the fork; the module's function `warm`, if any, is called then.
    - returns: the type that the result is checked against.
    - arguments: plain values, data classes of them, paths, small arrays, and settings. Only the settings that
      readers need are sent.
    - settings: contain the limits.
    - folder: the function may write here. It may read paths among the arguments.
    - field: name of the file in errors.

    Raise the function's error if it is one of `ERRORS`, MissingExtraError or OSError. Raise InvalidDataError if it
    crashed or reached a limit, TooLargeError if the limit is one of size, UnexpectedReaderError for any other error.
    """
    limits = settings.parser_memory_bytes, cpu_s(settings), settings.parser_s, settings.max_unpacked_bytes
    paths = [os.fspath(each) for each in arguments if isinstance(each, Path)]
    write = [] if folder is None else [os.fspath(folder)]
    encoded = msgspec.Raw(msgspec.msgpack.encode(arguments, enc_hook=to_plain))
    outcome = _ask(Call(function, encoded, paths, write, *limits))
    if outcome.output:
        shown = readable(outcome.output.decode(errors="backslashreplace"))[:MAX_OUTPUT_BYTES]
        logger.warning("output of a reader of an upload", extra={"fields": {"reader": function, "output": shown}})
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
        logger.warning("a reader of an upload sent an invalid answer: %s", error)
    message = f"The upload could not be read: its reader {_ending(outcome.status)}."
    raise invalid_data(field, "unreadable", "an undamaged file", message)


def _decoder(kind: type[T]) -> msgspec.msgpack.Decoder[T]:
    """Return a decoder, made by one thread at a time.

    Two threads that first use a msgspec type at the same time can crash the process.
    """
    with _making:
        return msgspec.msgpack.Decoder(kind, dec_hook=from_plain)


def _ask(call: Call) -> Outcome:
    data = msgspec.msgpack.encode(call)
    for _ in range(2):
        try:
            connection, process = _spawner.connect()
            with connection:
                _start_call(call, connection, process)
                connection.settimeout(call.wall_s + IMPORT_S)
                send(connection, data)
                return _decoder(Outcome).decode(receive(connection))
        # the waiting process had just ended, hangs, or cannot start
        except (EOFError, OSError) as error:
            failed = error
    raise NotReadyError(f"uploads cannot be read at present: no reader process could be started ({failed!r})")


def _start_call(call: Call, connection: socket.socket, process: Any) -> None:
    """Send the name of a call's function and wait until a process accepts the call.

    Raise TimeoutError if the waiting process hangs; it is killed first.
    """
    progress = Progress(lambda: [process.pid], call.wall_s, IMPORT_S)
    connection.settimeout(CHECK_S)
    send(connection, call.function.encode())
    while True:
        try:
            if connection.recv(1):
                return
            raise EOFError
        except TimeoutError:
            if (reason := progress.check()) is not None:
                logger.error("the process that reads uploads hangs and is killed: %s", reason)
                _spawner.end(process)
                raise


def cpu_s(settings: Settings) -> int:
    """Return the max processor time for reading one upload, s."""
    return max(1, round(CPU_SHARE * settings.parser_s))


def _beyond(limit: str, field: str, settings: Settings) -> ServiceError:
    """Return the error of a file that exceeds a limit."""
    of = {
        "memory": ("memory", f"{settings.parser_memory_bytes} bytes", "LIPSERVE_PARSER_MEMORY_BYTES"),
        "processor": ("processor time", f"{cpu_s(settings)} s", "LIPSERVE_PARSER_S"),
        "time": ("time", f"{settings.parser_s:g} s", "LIPSERVE_PARSER_S"),
        "files": ("open files", f"{MAX_OPEN_FILES}", None),
        "size": ("space", f"{settings.max_unpacked_bytes} bytes", "LIPSERVE_MAX_UNPACKED_BYTES"),
    }
    what, most, setting = of[limit]
    expected = f"at most {most}" + ("" if setting is None else f" ({setting} sets it)")
    message = f"Reading the upload takes more than {most} of {what}" + (f" ({setting})." if setting else ".")
    error = invalid_data(field, f"an upload that takes more than {most} of {what} to read", expected, message)
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
    """The child process that waits for calls; started on the first call."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._control: socket.socket | None = None
        self._process: Any = None
        self._owner = 0

    def connect(self) -> tuple[socket.socket, Any]:
        """Return a connection for one call and the process that receives it; raise OSError if none can start."""
        ours, theirs = socket.socketpair()
        with theirs, self._lock:
            control = self._control if self._owner == os.getpid() else None  # a forked process starts its own
            try:
                if control is None:
                    raise ConnectionError
                socket.send_fds(control, [b"c"], [theirs.fileno()])
            except ConnectionError:  # the process ended because no call arrived for long
                socket.send_fds(self._start(), [b"c"], [theirs.fileno()])
            return ours, self._process

    def end(self, process: Any) -> None:
        """Kill a process; the next call starts another one."""
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
    """Start a process that serves the calls of a socket, with only the descriptors and variables that it needs."""
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
        start_new_session=True,  # Ctrl-C must not reach it
    )


_spawner = _Spawner()

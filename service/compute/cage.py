"""Functions that read strangers' files, called in a process that can do nothing else: see `confinement`.

A process that has imported the readers waits for calls and is forked for each, which takes milliseconds: first into one
that watches, then into the one that is confined and calls the function. What goes there are names, paths and plain
values; what comes back is data of a type that the caller names, checked against it. Nothing is unpickled. A process
that crashes, hangs or takes too much costs its own call an answer of 422 or 413, and nobody else anything.
"""

from __future__ import annotations

import faulthandler
import importlib
import json
import logging
import os
import resource
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from errno import EFBIG, EMFILE
from pathlib import Path
from typing import Any, NoReturn, TypeVar, get_origin, get_type_hints

import msgspec
import numpy as np

from lipcore.extras import MissingExtraError
from service.compute.confinement import OPEN_FILES, Bounds, confine, protections
from service.compute.remote import imported
from service.foundation.errors import (
    InvalidDataError,
    InvalidRequestError,
    NotReadyError,
    ServiceError,
    StorageFullError,
    TooLargeError,
    invalid_data,
    problem,
    readable,
)
from service.foundation.settings import Settings

logger = logging.getLogger(__name__)
T = TypeVar("T")

NICENESS = 5
"""Of a confined process: a control loop goes before an upload."""
IDLE_S = 600.0
"""Seconds without a call after which the process that waits for calls ends; the next call starts another one."""
IMPORT_S = 120.0
"""Longest wait in s for a process that is yet to be started, or to import a reader, on a busy machine."""
ANSWER_BYTES = 32 * 1024 * 1024
"""Largest answer: names and facts, as numbers come in files."""
OUTPUT_BYTES = 4096
"""Most that is kept of what a confined process, or a library in it, writes to stdout and stderr."""
ENVIRONMENT = {
    "LANG": "C.UTF-8",
    "OPENBLAS_NUM_THREADS": "1",  # a thread that runs when a process is forked is not in the fork
    "OMP_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "2",  # each takes address space, used or not
    "ARROW_DEFAULT_MEMORY_POOL": "system",
}
KEPT_VARIABLES = ("LD_LIBRARY_PATH", "NUMBA_CACHE_DIR", "TZ")
OF_READERS = ("max_", "min_", "require_signed", "trusted_signers")
"""How the settings begin that readers need. No secret does."""
ERRORS = {each.code: each for each in (InvalidDataError, InvalidRequestError, StorageFullError, TooLargeError)}
"""What a function may raise, by code; and MissingExtraError, OSError."""


class Call(msgspec.Struct):
    """A call. function: `module:function`; given: its arguments; read, write: files and folders that it is given."""

    function: str
    given: list[Any]
    read: list[str]
    write: list[str]
    memory: int
    cpu_s: int
    wall_s: float
    file: int


class Failure(msgspec.Struct):
    """What a function raised. code: of `ERRORS`, or `limit`, `extra`, `system`, `unexpected`; detail: (field, value,
    expected) each, or the limit's name; number: of an error of the system."""

    code: str
    message: str
    detail: list[tuple[str, str | None, str]] = []
    number: int = 0


class Answer(msgspec.Struct):
    """What a confined process sends: the value that its function returned, or why there is none."""

    value: msgspec.Raw = msgspec.Raw(b"\xc0")
    failure: Failure | None = None


class Outcome(msgspec.Struct):
    """What became of a confined process. status: exit code, negative where a signal ended it; late: whether it was
    ended for its time; output: what it wrote; answer: an `Answer`, empty where there is none."""

    status: int
    late: bool
    output: bytes
    answer: bytes


class UnexpectedReaderError(RuntimeError):
    """A reader failed with an error that it should not have, which the log shows."""


def run(
    function: str, returns: type[T], *given: Any, settings: Settings, folder: Path | None = None, field: str = "file"
) -> T:
    """Call `module:function` in a confined process; return what it does, of the type `returns`. Not for the event loop.

    function: its module is imported before the process is forked, and what that has to do first is done by a function
    `warm` of it; given: plain values, data classes of such, paths, settings (of which what readers need goes), small
    arrays; folder: may be written, paths among the arguments be read; field: what errors call the file. Raise what the
    function raises of `ERRORS`, MissingExtraError and OSError; InvalidDataError where it reached a limit or crashed,
    TooLargeError where that is one of size; UnexpectedReaderError for any other error of the function.
    """
    limits = settings.parser_memory_bytes, settings.parser_cpu_s, settings.parser_s, settings.max_unpacked_bytes
    paths = [os.fspath(each) for each in given if isinstance(each, Path)]
    write = [] if folder is None else [os.fspath(folder)]
    outcome = _ask(Call(function, msgspec.to_builtins(given, enc_hook=_plain), paths, write, *limits))
    if outcome.output:
        shown = readable(outcome.output.decode(errors="backslashreplace"))[:OUTPUT_BYTES]
        logger.warning("a reader of an upload wrote", extra={"fields": {"reader": function, "output": shown}})
    if outcome.late:
        raise _beyond("time", field, settings)
    if outcome.status == -signal.SIGXCPU:
        raise _beyond("processor", field, settings)
    try:
        answer = msgspec.msgpack.decode(outcome.answer, type=Answer)
        if answer.failure is not None:
            raise _error(answer.failure, function, field, settings)
        if outcome.status == 0:
            return msgspec.msgpack.decode(answer.value, type=returns, dec_hook=_typed)
    except msgspec.MsgspecError as error:
        logger.warning("a reader of an upload sent what is no answer: %s", error)
    raise invalid_data(field, f"one that cannot be read: its reader {_ending(outcome.status)}", "an undamaged one")


def _ask(call: Call) -> Outcome:
    data = msgspec.msgpack.encode(call)
    for _ in range(2):
        try:
            with _spawner.connect() as connection:
                connection.settimeout(call.wall_s + IMPORT_S)
                _send(connection, data)
                return msgspec.msgpack.decode(_receive(connection), type=Outcome)
        except TimeoutError:
            return Outcome(0, True, b"", b"")
        except (EOFError, OSError) as error:  # the process that waits for calls had just ended, or none can be started
            failed = error
    raise NotReadyError(f"uploads cannot be read now: no process can be started for it ({failed!r})")


def _beyond(limit: str, field: str, settings: Settings) -> ServiceError:
    """The error of a file that takes more than a limit."""
    of = {
        "memory": ("memory", f"{settings.parser_memory_bytes} bytes", "LIPSERVE_PARSER_MEMORY_BYTES"),
        "processor": ("processor time", f"{settings.parser_cpu_s} s", "LIPSERVE_PARSER_CPU_S"),
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


def _plain(value: Any) -> Any:
    if isinstance(value, Path):
        return os.fspath(value)
    if isinstance(value, Settings):
        return {name: getattr(value, name) for name in Settings.model_fields if name.startswith(OF_READERS)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise NotImplementedError(f"a {type(value).__name__}")


def _typed(kind: Any, value: Any) -> Any:
    if kind is Path:
        return Path(value)
    if kind is Settings:
        return Settings.model_construct(**value)  # they have been checked, and the environment is none of theirs
    if get_origin(kind) is np.ndarray:
        return np.array(value, dtype=np.float64)
    raise NotImplementedError(f"a {kind}")


class _Spawner:
    """The process of this one that waits for calls; started when it is needed."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._control: socket.socket | None = None
        self._process: Any = None
        self._owner = 0

    def connect(self) -> socket.socket:
        """A connection for one call; raise OSError where no process can be started."""
        ours, theirs = socket.socketpair()
        with theirs, self._lock:
            control = self._control if self._owner == os.getpid() else None  # a forked process starts its own
            try:
                if control is None:
                    raise ConnectionError
                socket.send_fds(control, [b"c"], [theirs.fileno()])
            except ConnectionError:  # it has ended, as it does when nobody calls
                socket.send_fds(self._start(), [b"c"], [theirs.fileno()])
        return ours

    def _start(self) -> socket.socket:
        self._owner = os.getpid()
        self._control, theirs = socket.socketpair()
        with theirs:
            self._process = start(theirs)
        return self._control


def start(control: socket.socket) -> Any:
    """Start a process that serves the calls of a socket, with no descriptor and no variable but what it needs."""
    path = json.dumps([os.path.abspath(each) for each in sys.path])
    code = "import json, sys; sys.path[:] = json.loads(sys.argv[1]); from service.compute import cage; cage.serve({})"
    return subprocess.Popen(  # noqa: S603 - our own
        [sys.executable, "-I", "-c", code.format(control.fileno()), path],
        pass_fds=[control.fileno()],
        stdin=subprocess.DEVNULL,
        env=ENVIRONMENT | {name: os.environ[name] for name in KEPT_VARIABLES if name in os.environ},
        cwd="/",
        start_new_session=True,  # Ctrl-C is not for it
    )


_spawner = _Spawner()


def serve(descriptor: int) -> None:
    """Fork a process for each call that comes, until the other end is closed or nothing comes for long."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for those that watch
    protections()
    known = set[str]()
    with socket.socket(fileno=descriptor) as control, suppress(TimeoutError):
        control.settimeout(IDLE_S)
        while descriptors := socket.recv_fds(control, 1, 1)[1]:
            with socket.socket(fileno=descriptors[0]) as connection, suppress(EOFError, ConnectionError):
                call = msgspec.msgpack.decode(_receive(connection), type=Call)
                if (module := call.function.partition(":")[0]) not in known:
                    known.add(module)
                    with suppress(Exception):  # what cannot be imported is told by the one that calls it
                        getattr(imported(module), "warm", bool)()
                if os.fork() == 0:
                    control.close()
                    _alone(_watch, call, connection)


def _alone(function: Callable[..., None], *given: Any) -> NoReturn:
    """Call a function in a forked process, and end that."""
    code = 1
    try:
        function(*given)
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def _watch(call: Call, connection: socket.socket) -> None:
    """Start the process that is to be confined, and see to its end; tell what became of it."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    (answer, answer_end), (output, output_end) = os.pipe(), os.pipe()
    pid = os.fork()
    if pid == 0:
        _alone(_confined, call, answer_end, output_end, os.getppid())
    os.close(answer_end)
    os.close(output_end)
    until = time.monotonic() + call.wall_s
    kept = _collected({answer: ANSWER_BYTES, output: OUTPUT_BYTES}, connection, until)
    ended = 0
    while kept is not None and not ended and time.monotonic() < until:  # it may close both and go on
        ended, status = os.waitpid(pid, os.WNOHANG)
        time.sleep(0 if ended else 0.0005)
    if not ended:
        os.kill(pid, signal.SIGKILL)
        _, status = os.waitpid(pid, 0)
    found = kept or {answer: b"", output: b""}
    outcome = Outcome(os.waitstatus_to_exitcode(status), not ended, found[output], found[answer])
    _send(connection, msgspec.msgpack.encode(outcome))


def _collected(most: dict[int, int], connection: socket.socket, until: float) -> dict[int, bytes] | None:
    """What comes of some descriptors until the ends of all, up to so many bytes of each; None where that takes too
    long, or nobody waits for it any more."""
    kept = {each: bytearray() for each in most}
    poll = select.poll()
    poll.register(connection, 0)  # only whether the other end is closed
    for each in most:
        poll.register(each, select.POLLIN)
    opened = set(most)
    while opened:
        ready = [each for each, _ in poll.poll(max(0.0, until - time.monotonic()) * 1000)]
        if not ready or connection.fileno() in ready:
            return None
        for each in ready:
            piece = os.read(each, 1 << 16)
            kept[each] += piece[: most[each] - len(kept[each])]
            if not piece:
                poll.unregister(each)
                opened.discard(each)
    return {each: bytes(content) for each, content in kept.items()}


def _confined(call: Call, answer: int, output: int, parent: int) -> None:
    """Call the function with what is left to it, and send what comes of it."""
    os.setsid()
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.closerange(3, answer)
    os.closerange(answer + 1, resource.getrlimit(resource.RLIMIT_NOFILE)[0])
    faulthandler.enable()
    os.nice(NICENESS)
    for name in ("TMPDIR", "SQLITE_TMPDIR"):
        os.environ[name] = next(iter(call.write), "/nonexistent")
    confine(Bounds(call.memory, call.cpu_s, call.file), map(Path, call.read), map(Path, call.write))
    if os.getppid() != parent:  # it has ended before this one could ask to end with it
        return
    try:
        module, _, name = call.function.partition(":")
        function = getattr(importlib.import_module(module), name)
        kinds = [kind for what, kind in get_type_hints(function).items() if what != "return"]
        given = [msgspec.convert(each, kind, dec_hook=_typed) for each, kind in zip(call.given, kinds, strict=True)]
        value = msgspec.msgpack.encode(function(*given), enc_hook=_plain)
        sent = Answer(value=msgspec.Raw(value))
    except Exception as error:
        sent = Answer(failure=_failure(error))
    with os.fdopen(answer, "wb") as file:
        file.write(msgspec.msgpack.encode(sent))


def _failure(error: Exception) -> Failure:
    """What is told of an error. A limit that was reached may be its cause, whatever a reader made of that."""
    each: BaseException | None = error
    while each is not None:
        if isinstance(each, MemoryError):
            return Failure("limit", "memory")
        if isinstance(each, OSError) and each.errno in _LIMITS:
            return Failure("limit", _LIMITS[each.errno])
        each = each.__context__
    if isinstance(error, ServiceError) and error.code in ERRORS:
        return Failure(error.code, error.message, [(item.field, item.value, item.expected) for item in error.detail])
    if isinstance(error, MissingExtraError):
        return Failure("extra", str(error), [(error.extra, error.lacking, error.reason or "")])
    if isinstance(error, OSError) and error.errno:
        return Failure("system", str(error), number=error.errno)
    traceback.print_exception(error)
    return Failure("unexpected", f"{type(error).__name__}: {error}"[:1000])


_LIMITS = {EFBIG: "size", EMFILE: "files"}
_LENGTH = struct.Struct("<Q")


def _send(connection: socket.socket, data: bytes) -> None:
    connection.sendall(_LENGTH.pack(len(data)) + data)


def _receive(connection: socket.socket) -> bytes:
    """What the other end sent; raise EOFError where it is closed before."""
    (length,) = _LENGTH.unpack(_exactly(connection, _LENGTH.size))
    return _exactly(connection, length)


def _exactly(connection: socket.socket, count: int) -> bytes:
    data = bytearray()
    while len(data) < count:
        piece = connection.recv(min(count - len(data), 1 << 20))
        if not piece:
            raise EOFError
        data += piece
    return bytes(data)

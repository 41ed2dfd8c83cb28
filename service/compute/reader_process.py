"""The process that `cage` calls: it waits for calls, and is forked for each, first into one that watches, then into the
one that is confined and calls the function."""

from __future__ import annotations

import faulthandler
import importlib
import os
import resource
import select
import signal
import socket
import struct
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from errno import EFBIG, EMFILE
from pathlib import Path
from typing import Any, NoReturn, get_origin, get_type_hints

import msgspec
import numpy as np

from lipcore.extras import MissingExtraError
from service.compute.confinement import Bounds, confine, protections
from service.compute.remote import imported
from service.foundation.errors import (
    InvalidDataError,
    InvalidRequestError,
    ServiceError,
    StorageFullError,
    TooLargeError,
)
from service.foundation.settings import Settings

NICENESS = 5
"""Of a confined process: a control loop goes before an upload."""
IDLE_S = 600.0
"""Seconds without a call after which the process that waits for calls ends; the next call starts another one."""
ANSWER_BYTES = 32 * 1024 * 1024
"""Largest answer: names and facts, as numbers come in files."""
OUTPUT_BYTES = 4096
"""Most that is kept of what a confined process, or a library in it, writes to stdout and stderr."""
OF_READERS = ("max_", "min_", "require_signed", "trusted_signers")
"""How the settings begin that readers need. No secret does."""
ERRORS = {each.code: each for each in (InvalidDataError, InvalidRequestError, StorageFullError, TooLargeError)}
"""What a function may raise, by code; and MissingExtraError, OSError."""


class Call(msgspec.Struct):
    """A call. function: `module:function`; arguments: its own; read, write: files and folders that it is given."""

    function: str
    arguments: list[Any]
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


def serve(descriptor: int) -> None:
    """Fork a process for each call that comes, until the other end is closed or nothing comes for long."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for those that watch
    protections()
    known = set[str]()
    with socket.socket(fileno=descriptor) as control, suppress(TimeoutError):
        control.settimeout(IDLE_S)
        while descriptors := socket.recv_fds(control, 1, 1)[1]:
            with socket.socket(fileno=descriptors[0]) as connection, suppress(EOFError, ConnectionError):
                call = msgspec.msgpack.decode(receive(connection), type=Call)
                if (module := call.function.partition(":")[0]) not in known:
                    known.add(module)
                    with suppress(Exception):  # the one that calls it says what cannot be imported
                        getattr(imported(module), "warm", bool)()
                if os.fork() == 0:
                    control.close()
                    _alone(_watch, call, connection)


def _alone(function: Callable[..., None], *arguments: Any) -> NoReturn:
    """Call a function in a forked process, and end that."""
    code = 1
    try:
        function(*arguments)
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def _watch(call: Call, connection: socket.socket) -> None:
    """Start the process that is to be confined, and see to its end; send what became of it."""
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
    collected = kept or {answer: b"", output: b""}
    outcome = Outcome(os.waitstatus_to_exitcode(status), not ended, collected[output], collected[answer])
    send(connection, msgspec.msgpack.encode(outcome))


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
        arguments = [
            msgspec.convert(each, kind, dec_hook=typed) for each, kind in zip(call.arguments, kinds, strict=True)
        ]
        value = msgspec.msgpack.encode(function(*arguments), enc_hook=plain)
        sent = Answer(value=msgspec.Raw(value))
    except Exception as error:
        sent = Answer(failure=_failure(error))
    with os.fdopen(answer, "wb") as file:
        file.write(msgspec.msgpack.encode(sent))


def _failure(error: Exception) -> Failure:
    """What is sent of an error. A limit that was reached may be its cause, whatever a reader made of that."""
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


def plain(value: Any) -> Any:
    """A path, settings or an array as what goes to another process; for msgspec."""
    if isinstance(value, Path):
        return os.fspath(value)
    if isinstance(value, Settings):
        return {name: getattr(value, name) for name in Settings.model_fields if name.startswith(OF_READERS)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise NotImplementedError(f"a {type(value).__name__}")


def typed(kind: Any, value: Any) -> Any:
    """The way back from `plain`."""
    if kind is Path:
        return Path(value)
    if kind is Settings:
        return Settings.model_construct(**value)  # they have been checked, and the environment is none of theirs
    if get_origin(kind) is np.ndarray:
        return np.array(value, dtype=np.float64)
    raise NotImplementedError(f"a {kind}")


_LIMITS = {EFBIG: "size", EMFILE: "files"}
_LENGTH = struct.Struct("<Q")


def send(connection: socket.socket, data: bytes) -> None:
    """Send data with their length."""
    connection.sendall(_LENGTH.pack(len(data)) + data)


def receive(connection: socket.socket) -> bytes:
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

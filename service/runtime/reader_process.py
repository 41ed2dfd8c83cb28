"""The process that `cage` calls. It forks ahead of each call: first a watching process, which forks the confined one.

The confined process calls the function.
"""

from __future__ import annotations

import faulthandler
import os
import resource
import select
import signal
import socket
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from errno import EFBIG, EMFILE
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn, get_type_hints

import msgspec

from lipcore.extras import MissingExtraError
from service.foundation.errors import ServiceError
from service.runtime.confinement import Bounds, confine, drop_privileges, own_files, protections
from service.runtime.reader_messages import (
    ERRORS,
    MAX_ANSWER_BYTES,
    MAX_OUTPUT_BYTES,
    Answer,
    Call,
    Failure,
    Outcome,
    from_plain,
    prepend_length,
    receive,
    send,
    to_plain,
    unpack_complete,
)
from service.runtime.remote import import_without_gc

_LIMITS = {EFBIG: "size", EMFILE: "files"}


def serve(descriptor: int) -> None:
    """Pass each call to a process forked for it, until the other end closes or no call arrives for 600 s."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel removes ended watching processes
    protections(), own_files()  # slow: cached before the fork
    known = set[str]()
    with socket.socket(fileno=descriptor) as control, suppress(TimeoutError):
        control.settimeout(600.0)  # then this process ends, and the next call starts another one
        ready = _ahead(control)
        while descriptors := socket.recv_fds(control, 1, 1)[1]:
            with socket.socket(fileno=descriptors[0]) as connection, suppress(EOFError, ConnectionError):
                if (function := receive(connection).decode()) not in known:
                    known.add(function)
                    with suppress(Exception):  # the confined process reports a failed import
                        getattr(import_without_gc(function.partition(":")[0]), "warm", bool)()
                        _resolved(function)
                    ready.close()
                    ready = _ahead(control)
                socket.send_fds(ready, [b"c"], [connection.fileno()])
            ready.close()
            ready = _ahead(control)


def _ahead(control: socket.socket) -> socket.socket:
    """Fork the watching process of the next call; return the socket on which it waits for the call's connection."""
    ours, theirs = socket.socketpair()
    with theirs:
        if os.fork() == 0:
            control.close()
            ours.close()
            _alone(_watch, theirs)
    return ours


@cache
def _resolved(function: str) -> tuple[Callable[..., Any], msgspec.msgpack.Decoder[Any]]:
    """Return the function of `module:function`, and the decoder of its arguments."""
    module, _, name = function.partition(":")
    resolved = getattr(import_without_gc(module), name)
    kinds = [kind for what, kind in get_type_hints(resolved).items() if what != "return"]
    return resolved, msgspec.msgpack.Decoder(tuple[*kinds], dec_hook=from_plain)  # type: ignore[valid-type]


def _alone(function: Callable[..., None], *arguments: Any) -> NoReturn:
    """Call a function in a forked process, then end the process."""
    code = 1
    try:
        function(*arguments)
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def _watch(calls: socket.socket) -> None:
    """Fork the confined process, pass the next call to it, and wait for its end."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    (given, given_end), (answer, answer_end), (output, output_end) = os.pipe(), os.pipe(), os.pipe()
    pid = os.fork()
    if pid == 0:
        _alone(_confined, given, answer_end, output_end, os.getppid())
    for each in (given, answer_end, output_end):
        os.close(each)
    for descriptor in socket.recv_fds(calls, 1, 1)[1]:  # empty if there will be no call
        with socket.socket(fileno=descriptor) as connection, suppress(EOFError, ConnectionError):
            connection.sendall(b"c")  # confirms that it has the call
            data = receive(connection)
            with suppress(BrokenPipeError), os.fdopen(given_end, "wb") as file:
                file.write(data)
            _supervise(pid, answer, output, connection, msgspec.msgpack.decode(data, type=Call).wall_s)


def _supervise(pid: int, answer: int, output: int, connection: socket.socket, wall_s: float) -> None:
    """Send the outcome of a process once it has answered or ended; kill it at its time limit."""
    until = time.monotonic() + wall_s
    content, written, in_time = _collected(answer, output, connection, until)
    if content is not None:
        os.kill(pid, signal.SIGKILL)  # it has answered; a normal exit takes milliseconds
        send(connection, msgspec.msgpack.encode(Outcome(0, False, written, content)))
        os.waitpid(pid, 0)
        return
    ended = 0
    while in_time and not ended and time.monotonic() < until:  # it may close both and keep running
        ended, status = os.waitpid(pid, os.WNOHANG)
        time.sleep(0 if ended else 0.0005)
    if not ended:
        os.kill(pid, signal.SIGKILL)
        _, status = os.waitpid(pid, 0)
    send(connection, msgspec.msgpack.encode(Outcome(os.waitstatus_to_exitcode(status), not ended, written, b"")))


def _collected(answer: int, output: int, connection: socket.socket, until: float) -> tuple[bytes | None, bytes, bool]:
    """Return the complete answer, the output so far, and whether the call is still in time and its caller connected.

    The answer is None if the process ends first. MAX_ANSWER_BYTES and MAX_OUTPUT_BYTES limit both.
    """
    most = {answer: MAX_ANSWER_BYTES, output: MAX_OUTPUT_BYTES}
    kept = {each: bytearray() for each in most}
    poll = select.poll()
    poll.register(connection, 0)  # reports only that the other end is closed
    for each in most:
        poll.register(each, select.POLLIN)
    opened, in_time, content = set(most), True, None
    while opened and in_time and content is None:
        ready = [each for each, _ in poll.poll(max(0.0, until - time.monotonic()) * 1000)]
        for each in opened.intersection(ready):
            piece = os.read(each, 1 << 16)
            kept[each] += piece[: most[each] - len(kept[each])]
            if not piece:
                poll.unregister(each)
                opened.discard(each)
        in_time = time.monotonic() < until and connection.fileno() not in ready
        content = unpack_complete(kept[answer])
    os.set_blocking(output, False)
    with suppress(BlockingIOError):  # output written before the answer
        kept[output] += os.read(output, MAX_OUTPUT_BYTES - len(kept[output]))
    return content, bytes(kept[output]), in_time


def _confined(given: int, answer: int, output: int, parent: int) -> None:
    """Wait for a call, confine the process, call the function, and send the answer."""
    os.setsid()
    os.dup2(output, 1)
    os.dup2(output, 2)
    for low, high in pairwise([2, *sorted((given, answer)), resource.getrlimit(resource.RLIMIT_NOFILE)[0]]):
        os.closerange(low + 1, high)
    faulthandler.enable()
    os.nice(5)  # control loops have priority over uploads
    drop_privileges()
    if os.getppid() != parent:  # the parent ended before this process could ask to end with it
        return
    with os.fdopen(given, "rb") as file:
        data = file.read()
    if not data:  # there will be no call
        return
    call = msgspec.msgpack.decode(data, type=Call)
    for variable in ("TMPDIR", "SQLITE_TMPDIR"):
        os.environ[variable] = next(iter(call.write), "/nonexistent")
    confine(Bounds(call.memory, call.cpu_s, call.file), map(Path, call.read), map(Path, call.write))
    try:
        function, decoder = _resolved(call.function)
        value = msgspec.msgpack.encode(function(*decoder.decode(call.arguments)), enc_hook=to_plain)
        sent = Answer(value=msgspec.Raw(value))
    except Exception as error:
        sent = Answer(failure=_failure(error))
    with os.fdopen(answer, "wb") as file:
        file.write(prepend_length(msgspec.msgpack.encode(sent)))


def _failure(error: Exception) -> Failure:
    """Return the failure to send. A reached limit may be the cause of an error, whatever the reader made of it."""
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

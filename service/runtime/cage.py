"""Calls of functions that read untrusted files, each in a confined process: see `confinement`.

A fork server of the standard library, which has imported the readers, forks a process for each call. The result comes
back as data of a type that the caller names; it is checked, and never unpickled.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import time
import traceback
from contextlib import suppress
from functools import cache
from importlib import import_module
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from lipcore.extras import MissingExtraError
from service.foundation import errors
from service.foundation.errors import ServiceError, invalid_data, problem, readable
from service.foundation.settings import Settings
from service.runtime.confinement import ENVIRONMENT, MAX_OPEN_FILES, confine

logger = logging.getLogger(__name__)
T = TypeVar("T")
CPU_SHARE = 0.5
"""Max processor time of one upload's reader, as a share of its max time."""
MAX_ANSWER_BYTES = 32 * 1024 * 1024
"""Max size of an answer: names and facts, as numbers are sent in files."""
_KINDS = errors.InvalidDataError, errors.InvalidRequestError, errors.StorageFullError, errors.TooLargeError
ERRORS = {each.code: each for each in _KINDS}
"""Errors that a function may raise, by code; MissingExtraError and OSError are allowed too."""
_starting = threading.Lock()


class UnexpectedReaderError(RuntimeError):
    """A reader failed with an unexpected error; the log shows it."""


class Answer(msgspec.Struct):
    """The value of a function, or its error: a code of ERRORS, `limit`, `extra`, `system` or `unexpected`."""

    value: msgspec.Raw = msgspec.Raw(b"\xc0")
    error: str | None = None
    message: str = ""
    detail: list[tuple[str, str | None, str]] = []
    number: int = 0


_ANSWERS = msgspec.msgpack.Decoder(Answer)


def run(
    function: str,
    returns: type[T],
    *arguments: Any,
    settings: Settings,
    folder: Path | None = None,
    field: str = "file",
) -> T:
    """Call `module:function` in a confined process; return its result as the type `returns`.

    Blocking: use it in a thread. settings: contain the limits. folder: the function may write here; it may read paths
    among the arguments. Of settings among the arguments, only limits are sent. field: name of the file in errors.

    Raise the function's error if it is one of `ERRORS`, MissingExtraError or OSError. Raise InvalidDataError if it
    crashed or reached a limit, TooLargeError if the limit is one of size, UnexpectedReaderError for any other error.
    """
    given = tuple(_limits_of(each) if isinstance(each, Settings) else each for each in arguments)
    bounds = settings.parser_memory_bytes, cpu_s(settings), settings.max_unpacked_bytes
    ours, theirs = multiprocessing.Pipe(duplex=False)
    with ours:
        with theirs, _starting:
            process = _context().Process(
                target=_answer, args=(theirs, function, given, bounds, folder, settings.parser_s), daemon=True
            )
            try:
                process.start()
            except (OSError, EOFError) as error:
                reason = f"uploads cannot be read at present: no reader process could be started ({error!r})"
                raise errors.NotReadyError(reason) from None
        content, until = b"", time.monotonic() + settings.parser_s
        wait([ours, process.sentinel], settings.parser_s)
        with suppress(EOFError, OSError):
            content = ours.recv_bytes(MAX_ANSWER_BYTES) if ours.poll() else b""
    late = not content and not wait([process.sentinel], max(0.0, until - time.monotonic()))
    if content or late:
        process.kill()  # it has answered; a normal exit takes milliseconds
    process.join()
    if late:
        raise _beyond("time", field, settings)
    if process.exitcode == -signal.SIGXCPU:
        raise _beyond("processor", field, settings)
    try:
        answer = _ANSWERS.decode(content)
        if answer.error is None:
            return _decoder(returns).decode(answer.value)
    except msgspec.MsgspecError:
        code = process.exitcode or 0
        ending = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        message = f"The upload could not be read: its reader {ending}."
        raise invalid_data(field, "unreadable", "an undamaged file", message) from None
    raise _error(answer, function, field, settings)


def cpu_s(settings: Settings) -> int:
    """Return the max processor time for reading one upload, s."""
    return max(1, round(CPU_SHARE * settings.parser_s))


def _decoder(kind: type[T]) -> msgspec.msgpack.Decoder[T]:
    """Return a decoder, made by one thread at a time: two that first use a type of msgspec can crash the process."""
    with _starting:
        return msgspec.msgpack.Decoder(kind)


@cache
def _context() -> Any:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["service.runtime.preload"])
    return context


def _limits_of(settings: Settings) -> Settings:
    """Return settings without secrets."""
    names = [name for name in Settings.model_fields if name.startswith(("max_", "min_"))]
    return Settings.model_construct(**{name: getattr(settings, name) for name in names})


def _answer(
    connection: Connection,
    function: str,
    given: tuple[Any, ...],
    bounds: tuple[int, int, int],
    folder: Path | None,
    wall_s: float,
) -> None:
    """Confine this process, call the function, and send the answer."""
    os.setsid()
    signal.alarm(int(wall_s) + 2)  # ends it if the service was killed
    os.nice(5)  # control loops have priority over uploads
    nothing = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(3):
        os.dup2(nothing, descriptor)
    os.closerange(3, connection.fileno())
    os.closerange(connection.fileno() + 1, 1 << 16)
    os.environ.clear()
    os.environ.update(ENVIRONMENT | dict.fromkeys(("TMPDIR", "SQLITE_TMPDIR"), str(folder or "/nonexistent")))
    module, _, name = function.partition(":")
    try:
        called = getattr(import_module(module), name)
        confine(*bounds, [each for each in given if isinstance(each, Path)], [] if folder is None else [folder])
        value = msgspec.msgpack.encode(called(*given))
        answer = Answer(msgspec.Raw(value))
    except Exception as error:
        answer = _failure(error)
    connection.send_bytes(msgspec.msgpack.encode(answer))


def _failure(error: Exception) -> Answer:
    """Return the error to send. A reached limit may be the cause of an error, whatever the reader made of it."""
    each: BaseException | None = error
    while each is not None:
        limit = {27: "size", 24: "files"}.get((isinstance(each, OSError) and each.errno) or 0)  # EFBIG, EMFILE
        if limit or isinstance(each, MemoryError):
            return Answer(error="limit", message=limit or "memory")
        each = each.__context__
    if isinstance(error, ServiceError) and error.code in ERRORS:
        detail = [(item.field, item.value, item.expected) for item in error.detail]
        return Answer(error=error.code, message=error.message, detail=detail)
    if isinstance(error, MissingExtraError):
        return Answer(error="extra", detail=[(error.extra, error.lacking, error.reason or "")])
    if isinstance(error, OSError) and error.errno:
        return Answer(error="system", number=error.errno)
    return Answer(error="unexpected", message="".join(traceback.format_exception(error))[-4000:])


def _error(answer: Answer, function: str, field: str, settings: Settings) -> Exception:
    if answer.error == "limit":
        return _beyond(answer.message, field, settings)
    if answer.error == "extra":
        extra, lacking, reason = answer.detail[0]
        return MissingExtraError(extra, str(lacking), reason or None)
    if answer.error == "system":
        return OSError(answer.number, os.strerror(answer.number))
    if answer.error in ERRORS:
        items = [problem(where, value, expected) for where, value, expected in answer.detail]
        return ERRORS[answer.error](readable(answer.message), items)
    return UnexpectedReaderError(f"{function}: {readable(answer.message)}")


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
    return errors.TooLargeError(error.message, error.detail) if limit == "size" else error

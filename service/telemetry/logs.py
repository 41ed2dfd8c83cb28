"""Log format, and the request or job that the running code belongs to."""

from __future__ import annotations

import itertools
import logging
import os
import secrets
import sys
import traceback
from collections.abc import Iterable, MutableMapping
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Literal, TextIO

request_id: ContextVar[str | None] = ContextVar("request_id", default=None)
"""Id of the current request, None outside of one."""
request_scope: ContextVar[MutableMapping[str, Any] | None] = ContextVar("request_scope", default=None)
"""ASGI scope of the current request, None outside of one."""
job_id: ContextVar[str | None] = ContextVar("job_id", default=None)
"""Id of the current job, None outside of one."""

REQUEST_ID = b"x-request-id"
"""Header with the id of a request: read from the client, and sent with every response."""
MAX_ID_CHARS = 64
KEY_ID = "lipserve.key_id"
"""Key of the API key's id in the ASGI scope of a request."""

_SEPARATORS = str.maketrans("", "", "._-")
_prefix = secrets.token_hex(6)
_numbers = itertools.count(1)


def _renew_prefix() -> None:
    """Give a forked process ids of its own."""
    global _prefix  # noqa: PLW0603 - one a process
    _prefix = secrets.token_hex(6)


os.register_at_fork(after_in_child=_renew_prefix)


def new_request_id() -> str:
    """Return an id that is unique among all processes; a counter costs less than randomness."""
    return f"{_prefix}-{next(_numbers):x}"


def read_request_id(headers: Iterable[tuple[bytes, bytes]]) -> str | None:
    """Return the id in the header of a request: up to 64 letters, digits and `._-`. Return None if it has no such id.

    Other characters must not get into logs and responses.
    """
    for name, value in headers:
        if name == REQUEST_ID:
            text = value.decode("latin-1")
            plain = text.translate(_SEPARATORS)
            return text if len(text) <= MAX_ID_CHARS and plain.isascii() and plain.isalnum() else None
    return None


Event = MutableMapping[str, Any]

REQUEST_LOG_PREFIXES = ("Exception in ASGI application", '%s - "WebSocket %s"', "connection open", "connection closed")
"""Beginnings of uvicorn's log lines about requests, which our outermost middleware logs with ids and without queries.
"""
_CONTROL = {code: f"\\x{code:02x}" for code in (*range(32), *range(127, 160))} | {
    code: f"\\u{code:04x}" for code in (0x2028, 0x2029, *range(0x200E, 0x2010), *range(0x202A, 0x202F))
}
"""Escapes of characters that must not be in a log line: control characters, line ends, marks of text direction."""


@dataclass(frozen=True)
class LogOptions:
    """Options of the log."""

    level: str = "info"
    """Lowest level that is logged."""
    form: Literal["console", "json"] = "console"
    """`console` for people, or `json`."""


_current: LogOptions | None = None


def current_options() -> LogOptions | None:
    """Return the log options of this process, for its child processes; None if it is not configured."""
    return _current


def configure(options: LogOptions | None) -> None:
    """Configure the log of this process; None changes nothing."""
    global _current  # noqa: PLW0603 - Python's logging is one for the process
    if options is None or options == _current:
        return
    _current = options
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_formatter(options.form))
    root, level = logging.getLogger(), options.level.upper()
    root.handlers[:] = [handler]
    # libraries log no debug lines: those of WebSockets contain headers, and headers contain API keys
    of_libraries = max(logging.getLevelName(level), logging.INFO)
    root.setLevel(of_libraries)
    for name in ("service", "lipcore"):
        logging.getLogger(name).setLevel(level)
    for name in ("uvicorn", "uvicorn.error", "uvicorn.access", "uvicorn.asgi"):
        logger = logging.getLogger(name)
        logger.handlers.clear()
        logger.propagate = True
        logger.setLevel(of_libraries)  # uvicorn traces to a logger without a level of its own
    logging.getLogger("alembic").setLevel(
        max(of_libraries, logging.WARNING)
    )  # its info lines describe only its own setup
    failures = logging.getLogger("uvicorn.error")
    if not any(isinstance(each, _RequestLogFilter) for each in failures.filters):
        failures.addFilter(_RequestLogFilter())
    logging.captureWarnings(True)


class _RequestLogFilter(logging.Filter):
    """Drops uvicorn's lines about requests."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a record is logged."""
        return not str(record.msg).startswith(REQUEST_LOG_PREFIXES)


def _formatter(form: str) -> logging.Formatter:
    import structlog  # noqa: PLC0415 - 0.1 s, for which a process that does not log need not wait

    renderers: list[Any]
    if form == "json":
        renderers = [structlog.processors.format_exc_info, structlog.processors.JSONRenderer(default=str)]
    else:
        colours = sys.stderr.isatty() and not os.environ.get("NO_COLOR")
        renderers = [structlog.dev.ConsoleRenderer(colors=colours, exception_formatter=_show_failure, pad_event_to=0)]
    return structlog.stdlib.ProcessorFormatter(
        foreign_pre_chain=[
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.stdlib.add_log_level,
            structlog.stdlib.add_logger_name,
            _add_fields,
            _add_ids,
            _make_printable,
        ],
        processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, *renderers],
    )


def _show_failure(out: TextIO, failure: Any) -> None:
    """Write a traceback, which may contain text from clients."""
    lines = "".join(traceback.format_exception(*failure)).splitlines()
    out.write("\n" + "\n".join(line.translate(_CONTROL) for line in lines))


def _add_fields(_: Any, __: str, event: Event) -> Event:
    event.update(getattr(event["_record"], "fields", {}))
    return event


def _add_ids(_: Any, __: str, event: Event) -> Event:
    """Add the ids of request, job and trace, and the process if it is not the main one."""
    for name, value in (("request_id", request_id.get()), ("job", job_id.get())):
        if value is not None:
            event[name] = value
    if (tracing := sys.modules.get("opentelemetry.trace")) is not None:
        span = tracing.get_current_span().get_span_context()
        if span.is_valid:
            event["trace_id"] = f"{span.trace_id:032x}"
    record: logging.LogRecord = event["_record"]
    if record.processName not in (None, "MainProcess"):
        event["process"] = record.processName
    return event


def _make_printable(_: Any, __: str, event: Event) -> Event:
    """Escape characters that could end a line or control a terminal, in texts from clients."""
    for name, value in event.items():
        if isinstance(value, str) and not value.isprintable():
            event[name] = value.strip().translate(_CONTROL)
    return event

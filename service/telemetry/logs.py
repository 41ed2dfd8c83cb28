"""Which request or job the code that runs belongs to, for logs and for what is stored."""

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
"""Id of the request that is answered, None outside of one."""
asked: ContextVar[MutableMapping[str, Any] | None] = ContextVar("asked", default=None)
"""ASGI scope of the request that is answered, None outside of one."""
job_id: ContextVar[str | None] = ContextVar("job_id", default=None)
"""Id of the job that is worked on, None outside of one."""

REQUEST_ID = b"x-request-id"
"""Header that names a request: taken from who asks, and in every answer."""
LONGEST_ID = 64
KEY_ID = "lipserve.key_id"
"""Key of the id of the API key in the ASGI scope of a request that came with one."""

_SEPARATORS = str.maketrans("", "", "._-")
_prefix = secrets.token_hex(6)
_numbers = itertools.count(1)


def new_request_id() -> str:
    """Return an id that no other request of this or of another process has: a counter costs less than randomness."""
    return f"{_prefix}-{next(_numbers):x}"


def given_request_id(headers: Iterable[tuple[bytes, bytes]]) -> str | None:
    """The id that a request brings, None where it brings none that can be taken: letters, digits and `._-`, up to 64.

    Whatever else a header may hold would go into logs and into answers.
    """
    for name, value in headers:
        if name == REQUEST_ID:
            text = value.decode("latin-1")
            plain = text.translate(_SEPARATORS)
            return text if len(text) <= LONGEST_ID and plain.isascii() and plain.isalnum() else None
    return None


Event = MutableMapping[str, Any]

LOGGED_BEFORE = ("Exception in ASGI application", '%s - "WebSocket %s"', "connection open", "connection closed")
"""Begin what uvicorn logs of requests, which the outermost middleware has logged: with their ids, without queries."""
_CONTROL = {code: f"\\x{code:02x}" for code in (*range(32), *range(127, 160))} | {
    code: f"\\u{code:04x}" for code in (0x2028, 0x2029, *range(0x200E, 0x2010), *range(0x202A, 0x202F))
}
"""What must not stand in a line: control characters, ends of lines, and marks that turn the direction of text."""


@dataclass(frozen=True)
class LogOptions:
    """level: lowest that is logged; form: `console` for people, or `json`."""

    level: str = "info"
    form: Literal["console", "json"] = "console"


_current: LogOptions | None = None


def current() -> LogOptions | None:
    """How this process logs, to be handed to those that it starts; None where it has not been told."""
    return _current


def configure(options: LogOptions | None) -> None:
    """Log in one form from now on, in this process; None leaves everything as it is."""
    global _current  # noqa: PLW0603 - Python's logging is one for the process
    if options is None or options == _current:
        return
    _current = options
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_formatter(options.form))
    root, level = logging.getLogger(), options.level.upper()
    root.handlers[:] = [handler]
    # libraries are not heard below info: what WebSockets say at debug is the headers, and with them the keys
    of_libraries = max(logging.getLevelName(level), logging.INFO)
    root.setLevel(of_libraries)
    for name in ("service", "lipcore"):
        logging.getLogger(name).setLevel(level)
    for name in ("uvicorn", "uvicorn.error", "uvicorn.access", "uvicorn.asgi"):
        logger = logging.getLogger(name)
        logger.handlers.clear()
        logger.propagate = True
        logger.setLevel(of_libraries)  # uvicorn takes a logger without a level of its own for one that traces
    logging.getLogger("alembic").setLevel(max(of_libraries, logging.WARNING))  # it tells of its own parts at info
    failures = logging.getLogger("uvicorn.error")
    if not any(isinstance(each, _LoggedBefore) for each in failures.filters):
        failures.addFilter(_LoggedBefore())
    logging.captureWarnings(True)


class _LoggedBefore(logging.Filter):
    """Drops what uvicorn says of requests."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether a record is news."""
        return not str(record.msg).startswith(LOGGED_BEFORE)


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
    """Write a traceback, in which what clients have sent may stand."""
    lines = "".join(traceback.format_exception(*failure)).splitlines()
    out.write("\n" + "\n".join(line.translate(_CONTROL) for line in lines))


def _add_fields(_: Any, __: str, event: Event) -> Event:
    event.update(getattr(event["_record"], "fields", {}))
    return event


def _add_ids(_: Any, __: str, event: Event) -> Event:
    """Say which request or job, and which process where it is not the service's own."""
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
    """Escape what could end a line or turn a terminal, in texts that clients have chosen."""
    for name, value in event.items():
        if isinstance(value, str) and not value.isprintable():
            event[name] = value.strip().translate(_CONTROL)
    return event

"""Output of commands: results on standard output, everything else on standard error.

An error message says what is wrong; its hint says what to do.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.markup import escape

# without a terminal, wide enough for the inertia matrix of seven joints
out = Console(soft_wrap=True, width=None if sys.stdout.isatty() else 160)
err = Console(stderr=True, soft_wrap=True)


def echo(text: str) -> None:
    """Print a line of a result without markup, colour or wrapping."""
    out.print(escape(text), highlight=False, soft_wrap=True)


def note(text: str) -> None:
    """Print a line to standard error, without markup."""
    err.print(escape(text), highlight=False, soft_wrap=True)


def print_warnings(texts: Iterable[str]) -> None:
    """Print warnings, one per line."""
    for text in texts:
        out.print(f"[yellow]warning:[/yellow] {escape(text)}", highlight=False, soft_wrap=True)


def print_json(value: Any, one_line: bool = False) -> None:
    """Print a result as one JSON document; see `plain`."""
    sys.stdout.write(json.dumps(plain(value), indent=None if one_line else 2, ensure_ascii=False, allow_nan=False))
    sys.stdout.write("\n")
    sys.stdout.flush()


def print_result(value: Any, as_json: bool, *lines: str) -> None:
    """Print a result as JSON, or else as lines of text."""
    if as_json:
        print_json(value)
        return
    for line in lines:
        echo(line)


def plain(value: Any) -> Any:
    """Convert records, arrays and paths to JSON types; numbers that are not finite become None."""
    if hasattr(value, "as_dict"):  # a record or a result of the client
        return value.as_dict()
    if is_dataclass(value) and not isinstance(value, type):
        return {each.name: plain(getattr(value, each.name)) for each in fields(value)}
    if hasattr(value, "tolist"):  # a NumPy array or scalar
        return plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(name): plain(each) for name, each in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


INTERRUPTED = 130
"""Exit code after Ctrl-C."""


class Explained(NamedTuple):
    """Error text for the user: what is wrong and, if known, what to do."""

    message: str
    hint: str | None = None


class CommandError(RuntimeError):
    """Error of a command, with a message and a hint for the user."""

    def __init__(self, message: str, hint: str | None = None) -> None:
        super().__init__(message)
        self.explained = Explained(message, hint)


def explain(error: Exception, expected: tuple[type[Exception], ...] = ()) -> Explained | None:
    """Return the text of an error that the user can act on; None for faults of the program and broken pipes.

    Args:
        error: The error.
        expected: Errors that the user can act on, beside ValueError, OSError and MissingExtraError.
    """
    if isinstance(error, CommandError):
        return error.explained
    if isinstance(error, BrokenPipeError) or not isinstance(error, (ValueError, OSError, *_missing(), *expected)):
        return None
    if isinstance(error, _refusals()):
        code, status = getattr(error, "code", ""), getattr(error, "status", None)
        return Explained(
            f"{error} ({code})" if status is None else f"{error} ({code}, {status})", hint_of(code, status)
        )
    return Explained(str(error))


def _refusals() -> tuple[type[Exception], ...]:
    """Return the error classes that carry an answer of the service."""
    return _imported({"lipserve.sending": "ApiError", "lipserve.answers": "StreamError"})


def _missing() -> tuple[type[Exception], ...]:
    """Return the error class of an extra that is not installed."""
    return _imported({"lipcore.extras": "MissingExtraError"})


def _imported(kinds: Mapping[str, str]) -> tuple[type[Exception], ...]:
    """Return error classes from modules that are imported: others cannot have been raised."""
    return tuple(getattr(sys.modules[module], name) for module, name in kinds.items() if module in sys.modules)


START = "start a service with `lipserve serve`, or set the address with --url or LIPSERVE_URL"


def hint_of(code: str, status: int | None = None) -> str | None:
    """Return what to do about an error code and HTTP status of the service, or None."""
    if status == 401 or code == "unauthorized":
        return (
            "set LIPSERVE_API_KEY to your API key. To create a key, run `lipserve keys create --name me --scope admin` "
            "on the machine with the service's home"
        )
    if status == 403 or code == "forbidden":
        return "this API key lacks a scope: create one with `lipserve keys create --name … --scope …`"
    if status in (429, 503):
        return "the service is busy: try again in a moment"
    if code == "unreachable":
        return START
    if code == "closed":
        return "open the stream again when the service is back: acknowledged torques are stored"
    return None


def print_error(error: Explained) -> None:
    """Print an error and its hint to standard error."""
    _line("[red]error:[/red]", error.message)
    if error.hint is not None:
        _line("[cyan]hint:[/cyan]", error.hint)


def _line(label: str, text: Any) -> None:
    err.print(f"{label} {escape(str(text))}", highlight=False, soft_wrap=True)

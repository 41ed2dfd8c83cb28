"""Where commands print: results to standard output, all else to standard error.

When a command cannot go on, that is what is wrong, then what to do about it.
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

# room for the inertia matrix of seven joints, where no terminal shows the table
out = Console(soft_wrap=True, width=None if sys.stdout.isatty() else 160)
err = Console(stderr=True, soft_wrap=True)


def echo(text: str) -> None:
    """Print a line of a result as it is: neither marked up, nor coloured, nor wrapped."""
    out.print(escape(text), highlight=False, soft_wrap=True)


def note(text: str) -> None:
    """Print a line that is no result to standard error."""
    err.print(escape(text), highlight=False, soft_wrap=True)


def print_warnings(texts: Iterable[str]) -> None:
    """Print what to be careful with, a line each."""
    for text in texts:
        out.print(f"[yellow]careful:[/yellow] {escape(text)}", highlight=False, soft_wrap=True)


def print_json(value: Any, one_line: bool = False) -> None:
    """Print a result as one JSON document; see `plain`."""
    sys.stdout.write(json.dumps(plain(value), indent=None if one_line else 2, ensure_ascii=False, allow_nan=False))
    sys.stdout.write("\n")
    sys.stdout.flush()


def print_result(value: Any, as_json: bool, *lines: str) -> None:
    """Print a result: as JSON, or else in lines."""
    if as_json:
        print_json(value)
        return
    for line in lines:
        echo(line)


def plain(value: Any) -> Any:
    """Return records, arrays, paths and numbers as JSON knows them; numbers that are not finite become null."""
    if hasattr(value, "as_dict"):  # a record or a result of the client
        return value.as_dict()
    if is_dataclass(value) and not isinstance(value, type):
        return {each.name: plain(getattr(value, each.name)) for each in fields(value)}
    if hasattr(value, "tolist"):  # of NumPy
        return plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(name): plain(each) for name, each in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


INTERRUPTED = 130
"""Exit code of what Ctrl-C has ended."""


class Explained(NamedTuple):
    """An error in words. message: what is wrong; hint: what to do about it, where that can be said."""

    message: str
    hint: str | None = None


class CommandError(RuntimeError):
    """A command cannot go on, and knows what to say."""

    def __init__(self, message: str, hint: str | None = None) -> None:
        super().__init__(message)
        self.explained = Explained(message, hint)


def explain(error: Exception, expected: tuple[type[Exception], ...] = ()) -> Explained | None:
    """Return what to say of an error; None for one that is no user's business: a fault, or the shell's broken pipe.

    expected: errors that a command's module says are the user's, beside ValueError, OSError and MissingExtraError.
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
    """Errors that tell what a service has said."""
    return _imported({"lipserve.sending": "ApiError", "lipserve.exchange": "StreamError"})


def _missing() -> tuple[type[Exception], ...]:
    """The error of an extra that is not installed."""
    return _imported({"lipcore.extras": "MissingExtraError"})


def _imported(kinds: Mapping[str, str]) -> tuple[type[Exception], ...]:
    """Errors by their modules, of those that are imported: others cannot have been raised."""
    return tuple(getattr(sys.modules[module], name) for module, name in kinds.items() if module in sys.modules)


START = "start a service with `lipserve serve`, or name another by --url or LIPSERVE_URL"


def hint_of(code: str, status: int | None = None) -> str | None:
    """What to do where the service refuses with this code and status of HTTP."""
    if status == 401 or code == "unauthorized":
        return (
            "the service asks for an API key: put yours into LIPSERVE_API_KEY; `lipserve keys create --name me --scope "
            "admin`, run where the service's home is, makes one"
        )
    if status == 403 or code == "forbidden":
        return "this key may not do that: `lipserve keys create --name … --scope …` makes one that may"
    if status in (429, 503):
        return "try again in a moment: the service says that it is busy"
    if code == "unreachable":
        return START
    if code == "closed":
        return "open the stream again once the service is back: what it has acknowledged is kept"
    return None


def print_error(error: Explained) -> None:
    """Print an error and its hint to standard error."""
    _line("[red]error:[/red]", error.message)
    if error.hint is not None:
        _line("[cyan]hint:[/cyan]", error.hint)


def _line(label: str, text: Any) -> None:
    err.print(f"{label} {escape(str(text))}", highlight=False, soft_wrap=True)

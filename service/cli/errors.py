"""What a user is told when a command cannot go on: what is wrong, then what to do about it."""

from __future__ import annotations

import sys
from typing import Any, NamedTuple

from rich.markup import escape

from service.cli.consoles import err

INTERRUPTED = 130
"""Exit code of what Ctrl-C has ended."""


class Told(NamedTuple):
    """An error in words. message: what is wrong; hint: what to do about it, where that can be said."""

    message: str
    hint: str | None = None


class CommandError(RuntimeError):
    """A command cannot go on, and knows what to say."""

    def __init__(self, message: str, hint: str | None = None) -> None:
        super().__init__(message)
        self.told = Told(message, hint)


def explain(error: Exception, expected: tuple[type[Exception], ...] = ()) -> Told | None:
    """Return what to say of an error; None for one that is no user's business: a fault, or the shell's broken pipe.

    expected: errors that a command's module says are the user's, beside ValueError and OSError.
    """
    if isinstance(error, CommandError):
        return error.told
    if isinstance(error, BrokenPipeError) or not isinstance(error, (ValueError, OSError, *expected)):
        return None
    if isinstance(error, _refusals()):
        code, status = getattr(error, "code", ""), getattr(error, "status", None)
        return Told(f"{error} ({code})" if status is None else f"{error} ({code}, {status})", hint_of(code, status))
    return Told(str(error))


def _refusals() -> tuple[type[Exception], ...]:
    """Errors that tell what a service has said, of modules that are imported: others cannot have been raised."""
    kinds = {"service.client.sending": "ApiError", "service.stream.messages": "StreamError"}
    return tuple(getattr(sys.modules[module], name) for module, name in kinds.items() if module in sys.modules)


START = "start a service with `lipserve serve`, or name another by --url or LIPSERVE_URL"
KEY = (
    "the service asks for an API key: put yours into LIPSERVE_KEY; `lipserve keys create --name me --scope admin`, run "
    "where the service's home is, makes one"
)
SCOPE = "this key may not do that: `lipserve keys create --name … --scope …` makes one that may"


def hint_of(code: str, status: int | None = None) -> str | None:
    """What to do where the service refuses with this code and status of HTTP."""
    if status == 401 or code == "unauthorized":
        return KEY
    if status == 403 or code == "forbidden":
        return SCOPE
    if status in (429, 503):
        return "try again in a moment: the service says that it is busy"
    if code == "unreachable":
        return START
    return None


def tell(told: Told) -> None:
    """Print an error and its hint to standard error."""
    _line("[red]error:[/red]", told.message)
    if told.hint is not None:
        _line("[cyan]hint:[/cyan]", told.hint)


def _line(label: str, text: Any) -> None:
    err.print(f"{label} {escape(str(text))}", highlight=False, soft_wrap=True)

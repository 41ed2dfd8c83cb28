"""The tree of commands, for the reference."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import typer

from service.cli.main import app

PROGRAM = "lipserve"


class Command(NamedTuple):
    """A command or a group of them. path: words that call it; command: as Typer knows it; context: to ask it."""

    path: tuple[str, ...]
    command: Any
    context: Any


def commands() -> Iterator[Command]:
    """All commands, groups before what is in them, in the order of their lists."""
    root = typer.main.get_command(app)
    yield from _below(Command((PROGRAM,), root, root.make_context(PROGRAM, [], resilient_parsing=True)))


def _below(at: Command) -> Iterator[Command]:
    yield at
    if not hasattr(at.command, "list_commands"):
        return
    load = getattr(at.command, "load", None)
    for name in at.command.list_commands(at.context):
        found = at.command.get_command(at.context, name) if load is None else load(name)
        context = found.make_context(name, [], parent=at.context, resilient_parsing=True)
        yield from _below(Command((*at.path, name), found, context))

"""A group of commands whose modules are imported when one of them is run, and not to list them."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

from service.cli.errors import explain, tell
from service.foundation.importing import imported


class Entry(NamedTuple):
    """Where a command is: `app` in a module, and what lists say of it."""

    module: str
    help: str
    panel: str


class LazyGroup(TyperGroup):
    """Commands by name in `entries`; lists and help show them as they are described there.

    What a command's module names in `ERRORS` is told to the user without a traceback, beside ValueError and OSError.
    """

    entries: ClassVar[Mapping[str, Entry]] = {}

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands = {
            name: TyperCommand(name, help=entry.help, rich_help_panel=entry.panel)
            for name, entry in self.entries.items()
        }

    def load(self, name: str) -> Any:
        """Import a command and return it; raise KeyError for an unknown one."""
        entry = self.entries[name]
        if entry.module not in sys.modules:
            imported(entry.module)
        found = typer.main.get_command(sys.modules[entry.module].app)
        found.name = name
        return found

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Find the command that is to be run, or whose options are to be completed; unknown ones are refused."""
        name, described, rest = super().resolve_command(ctx, args)
        return name, described if name is None else self.load(name), rest

    def invoke(self, ctx: Any) -> Any:
        """Run a command; what a user can act on is told in words, and ends it with 1."""
        try:
            return super().invoke(ctx)
        except Exception as error:
            entry = self.entries.get(ctx.invoked_subcommand)
            module = None if entry is None else sys.modules.get(entry.module)
            told = explain(error, getattr(module, "ERRORS", ()))
            if told is None:
                raise
            tell(told)
            raise typer.Exit(1) from error

"""`lipserve settings`."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Column, Table

from service.cli.consoles import CommandError, note, out, print_json
from service.cli.options import Json, alone, settings_of
from service.foundation.environment import REMOVED_VARIABLES, removal
from service.foundation.settings import describe

app = alone()
Words = Annotated[list[str] | None, typer.Argument(help="Words of the name or the meaning; case does not matter.")]


@app.command()
def settings(text: Words = None, as_json: Json = False) -> None:
    """List the settings, or those that contain all words, with the values that a service started here uses.

    Passwords are hidden.
    """
    words = [word.lower() for each in text or [] for word in each.split()]
    found = [each for each in describe(settings_of()) if has_words(f"{each.variable} {each.meaning}", words)]
    removed = [notice for name in REMOVED_VARIABLES if words and has_words(notice := removal(name), words)]
    if not found and not removed:
        raise CommandError(f"No setting contains `{' '.join(words)}`.", "`lipserve settings` lists all.")
    for notice in removed:
        note(notice)
    if as_json:
        print_json([each._asdict() for each in found])
    elif found:
        table = Table(Column("variable", no_wrap=True), "value", "default", Column("unit", no_wrap=True), "meaning")
        for each in found:
            table.add_row(*map(escape, each))
        out.print(table)


def has_words(text: str, words: list[str]) -> bool:
    """Return whether a text contains all words, which are in lower case."""
    return all(word in text.lower() for word in words)

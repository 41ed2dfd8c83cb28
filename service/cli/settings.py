"""`lipserve settings`."""

from __future__ import annotations

from rich.markup import escape
from rich.table import Column, Table

from service.cli.consoles import out, print_json
from service.cli.options import Json, alone, settings_of
from service.foundation.settings import describe

app = alone()


@app.command()
def settings(as_json: Json = False) -> None:
    """List all settings with the values that a service started here uses. Passwords are hidden."""
    found = describe(settings_of())
    if as_json:
        print_json([each._asdict() for each in found])
        return
    table = Table(Column("variable", no_wrap=True), "value", "default", Column("unit", no_wrap=True), "meaning")
    for each in found:
        table.add_row(*map(escape, each))
    out.print(table)

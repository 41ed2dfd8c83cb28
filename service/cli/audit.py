"""`lipserve audit`: list changes to models."""

from __future__ import annotations

import json
from itertools import islice
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Column, Table

from lipserve.address import DEFAULT_URL
from service.cli import connecting
from service.cli.connecting import connected
from service.cli.consoles import out, print_json
from service.cli.options import Json, Limit, Url, alone

if TYPE_CHECKING:
    from lipserve.records.audit import AuditEntry

app = alone()
MAX_VALUE_CHARACTERS = 60
"""Max length of a value in the table; JSON has the whole value."""


@app.command()
def audit(
    model: Annotated[str | None, typer.Option(help="Only this model.", autocompletion=connecting.models)] = None,
    key: Annotated[str | None, typer.Option(help="Only changes made with the API key of this id.")] = None,
    change: Annotated[str | None, typer.Option(help="Only this kind of change, e.g. `alias moved`.")] = None,
    since: Annotated[
        str | None, typer.Option(help="Only changes at or after this time, e.g. 2026-11-24T08:00:00Z.")
    ] = None,
    until: Annotated[str | None, typer.Option(help="Only changes before this time.")] = None,
    limit: Limit = 50,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """List changes to versions, aliases and learning options, newest first. Requires the scope admin."""
    with connected(url) as client:
        entries = list(islice(client.audit(model, key, change, since, until), limit))
    if as_json:
        print_json(entries)
        return
    table = Table(Column("at", no_wrap=True), "who", "by", "model", "change", "from", "to")
    for each in entries:
        at = each.at[:19].replace("T", " ")
        who = each.key_name or each.key or "-"
        values = (_value(each.before), _value(each.after))
        table.add_row(at, *map(escape, (who, each.what, each.model, _what(each), *values)))
    out.print(table)


def _what(entry: AuditEntry) -> str:
    if entry.alias is not None:
        return f"{entry.change}: {entry.alias}"
    return entry.change if entry.version is None else f"{entry.change}: {entry.version}"


def _value(value: Any) -> str:
    text = "-" if value is None else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= MAX_VALUE_CHARACTERS else f"{text[: MAX_VALUE_CHARACTERS - 1]}…"

"""`lipserve keys`: create, list and revoke API keys."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Column, Table

from service.api.access import keys
from service.api.access.scopes import SCOPES
from service.cli.consoles import note, out, print_json
from service.cli.options import Json, group, settings_of
from service.foundation.errors import InvalidRequestError
from service.foundation.settings import Settings
from service.storage.database import ApiKeyRow, Database
from service.storage.storage import HomeError, explain_home_errors

app = group("Create, list and revoke API keys of the home LIPSERVE_HOME. Works while the service is running.")
ERRORS = (HomeError, InvalidRequestError)
MAX_DAYS = 36_500.0


@app.command()
def create(
    name: Annotated[str, typer.Option(help="Name of the key, shown in lists.")],
    scope: Annotated[
        list[str],
        typer.Option(help=f"Scopes of the key: {', '.join(SCOPES)}. Separate several by commas or repeat the option."),
    ],
    days: Annotated[float | None, typer.Option(help="Days until the key expires. Default: never.")] = None,
    rate: Annotated[
        float | None,
        typer.Option(
            help="Max requests per second, instead of LIPSERVE_MAX_REQUESTS_PER_S. A burst may contain the requests "
            "of ten seconds, max LIPSERVE_MAX_REQUEST_BURST. A stream counts as one request."
        ),
    ] = None,
    file: Annotated[
        Path | None,
        typer.Option(help="File with an existing key to store: lip_ and 43 or more letters. It is not printed."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Create a key and print it to standard output. It cannot be shown again."""
    if days is not None and not 0 < days <= MAX_DAYS:
        raise ValueError(f"--days must be more than 0 and at most {MAX_DAYS:g}, got {days:g}")
    expires = None if days is None else datetime.now(UTC) + timedelta(days=days)
    with _database() as (database, settings):
        scopes = [part.strip() for given in scope for part in given.split(",")]
        given = None if file is None else file.read_text("utf-8").strip()
        row, secret = keys.create(database, name, scopes, expires, given, rate)
    if as_json:
        print_json({**_document(row), **({"key": secret} if given is None else {})})
        return
    if given is None:
        typer.echo(secret)
    expiry = f"expires {row.expires_at}" if row.expires_at else "no expiry"
    where = settings.home if settings.database_url is None else "the database LIPSERVE_DATABASE_URL"
    note(
        f"{row.id} created: scope {', '.join(row.scopes)}, {expiry}; running services on {where} accept it after "
        f"{keys.REFRESH_S:g} s"
    )


@app.command("list")
def list_(as_json: Json = False) -> None:
    """List all keys, without the keys themselves."""
    with _database() as (database, _):
        rows = keys.list_keys(database)
    if as_json:
        print_json([_document(row) for row in rows])
        return
    table = Table(Column("id", no_wrap=True), "name", "scopes", "state", "max req/s", "created", "expires", "last used")
    for row in rows:
        document = _document(row)
        times = (_minute(document[field]) for field in ("created_at", "expires_at", "used_at"))
        rate = "-" if row.max_requests_per_s is None else f"{row.max_requests_per_s:g}"
        table.add_row(row.id, escape(row.name), ", ".join(row.scopes), document["state"], rate, *times)
    out.print(table)


@app.command()
def revoke(
    key: Annotated[str, typer.Argument(help="Id of the key, key_…; see `lipserve keys list`.")],
    as_json: Json = False,
) -> None:
    """Revoke a key permanently. Running services reject it and close its streams within about a second."""
    with _database() as (database, _):
        row = keys.revoke(database, key)
    if as_json:
        print_json(_document(row))
        return
    note(f"{row.id} revoked; running services reject it after {keys.REFRESH_S:g} s")


@contextmanager
def _database() -> Iterator[tuple[Database, Settings]]:
    settings = settings_of()
    with explain_home_errors(settings), closing(Database.of(settings)) as database:
        yield database, settings


def _document(row: ApiKeyRow) -> dict[str, Any]:
    fields = ("id", "name", "scopes", "created_at", "expires_at", "revoked_at", "used_at", "max_requests_per_s")
    return {**{field: getattr(row, field) for field in fields}, "state": keys.state_of(row, time.time())}


def _minute(at: str | None) -> str:
    return "-" if at is None else at[:16].replace("T", " ")

"""`lipserve open`."""

from __future__ import annotations

import webbrowser
from http.client import HTTPException
from typing import Annotated
from urllib.parse import quote

import typer

from lipserve.address import DEFAULT_URL, UNIX
from service.cli import connecting
from service.cli.connecting import ask
from service.cli.consoles import START, CommandError, print_result
from service.cli.options import Json, Url, alone

app = alone()


@app.command("open")
def open_(
    model: Annotated[str | None, typer.Argument(help="Model to show.", autocompletion=connecting.models)] = None,
    live: Annotated[bool, typer.Option("--live", help="Use the live page, which shows streamed data.")] = False,
    browser: Annotated[
        bool, typer.Option("--browser", help="Also open the address in this machine's browser.")
    ] = False,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Print the address of the dashboard or of a model's page."""
    if url.startswith(UNIX):
        raise CommandError(f"browsers cannot open {url}: give an http:// address", "`lipserve serve --port 8000`")
    try:
        ask(url, "/health/live")
    except (OSError, HTTPException, ValueError) as error:
        raise CommandError(f"no service answers at {url}: {error}", START) from error
    page = "live" if live else "models" if model else ""
    address = f"{url.rstrip('/')}/#/{page}" + (f"/{quote(model, safe='')}" if model else "")
    print_result({"url": address}, as_json, address)
    if browser:
        webbrowser.open(address)

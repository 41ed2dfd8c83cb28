"""`lipserve verify`."""

from __future__ import annotations

import typer
from rich.markup import escape

from service.cli import verification
from service.cli.consoles import err, print_json, say
from service.cli.options import Json
from service.foundation.settings import Settings
from service.storage.home import HomeError, usable

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
ERRORS = (HomeError,)


@app.command()
def verify(as_json: Json = False) -> None:
    """Read everything that the home LIPSERVE_HOME stores and report what is damaged; also while the service runs."""
    settings = Settings()
    with usable(settings):
        found = verification.verify(settings)
    if as_json:
        print_json(found.shown())
    else:
        for damage in found.damages:
            err.print(f"[red]damaged:[/red] {escape(str(damage))}", highlight=False, soft_wrap=True)
        counts = ", ".join(f"{count} {kind}" for kind, count in found.read.items())
        say(f"read {counts}: {len(found.damages) or 'nothing'} damaged")
    if found.damages:
        raise typer.Exit(1)

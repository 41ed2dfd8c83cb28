"""`lipserve evaluate`."""

from __future__ import annotations

from typing import Annotated

import typer

from service.cli.connecting import connected, dataset_of
from service.cli.consoles import out, print_json
from service.cli.options import Alias, Data, Json, Model, Url, Version
from service.foundation.settings import DEFAULT_URL

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
def evaluate(
    model: Model,
    data: Data,
    url: Url = DEFAULT_URL,
    version: Version = None,
    alias: Alias = None,
    held_out: Annotated[
        bool, typer.Option("--held-out", help="Only on what the training of the version held out of it.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Compare a model with a recording, joint by joint. On what it was trained on, the figures flatter."""
    with connected(url) as client:
        dataset = dataset_of(client, data)
        answer = client.evaluate(model, dataset, version, alias, "held_out" if held_out else "all")
    if as_json:
        print_json(answer)
        return
    from service.cli.tables import evaluation_table  # noqa: PLC0415 - takes long to import; help needs none

    out.print(evaluation_table(answer))

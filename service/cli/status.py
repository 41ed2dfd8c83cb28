"""`lipserve status`."""

from __future__ import annotations

from lipserve.address import DEFAULT_URL
from service.cli.connecting import connected
from service.cli.consoles import echo, print_json
from service.cli.options import Json, Url, alone

app = alone()


@app.command()
def status(url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Print whether a service is ready, part by part, and which extras are not installed.

    Exits with code 1 if the service is not ready.
    """
    with connected(url) as client:
        health, extras = client.health(), client.abilities()
    if as_json:
        print_json(
            {**health.as_dict(), "can": dict(extras.can), "missing": [each.as_dict() for each in extras.missing]}
        )
        return
    echo(f"{url} is ready: LIPServe {health.version}")
    wide = max((len(each.name) for each in health.checks), default=0)
    for each in health.checks:
        echo(f"  {each.name:{wide}}  {each.state:7}  {each.message}")
    for extra in extras.missing:
        echo(f"not installed: {extra.install} to {extra.gives}")

"""`lipserve learning` and `lipserve alarms`: where the learning of a model stands, and what its owner decides."""

from __future__ import annotations

from itertools import islice
from typing import Annotated, Literal, cast

import typer
from rich.markup import escape
from rich.table import Table

from lipserve.address import DEFAULT_URL
from lipserve.wording import counted
from service.cli.connecting import connected
from service.cli.consoles import CommandError, echo, note, out, print_json, print_result
from service.cli.options import Json, Limit, Model, Url, alone, group

app = group("How a model learns: show it, and decide about a change that learning is held for.")
alarms_app = alone()
DECISIONS = ("adapt", "ignore")


@app.command()
def show(model: Model, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Print whether a model learns, from which streams, and what it waits for."""
    with connected(url) as client:
        learning = client.learning(model)
    if as_json:
        print_json(learning)
        return
    at = learning.status
    state = "is switched off" if not learning.options.enabled else "is held" if at.held is not None else "goes on"
    echo(f"{model} version {at.version}, revision {at.published} of {at.revision}: learning {state}")
    if at.held is not None:
        evidence = at.held.evidence
        echo(f"  since {evidence.get('cause') or evidence.get('kind', 'a change')}: {', '.join(evidence['joints'])}")
        note(f"`lipserve learning decide {model} adapt` or `ignore` ends it")
    if at.failure is not None:
        echo(f"  fails: {at.failure}")
    if at.streams:
        table = Table("stream", "sends", "last sequence", "missing", title="streams")
        for each in at.streams:
            table.add_row(escape(each.stream_id), each.kind, str(each.last), str(each.missing))
        out.print(table)


@app.command()
def decide(
    model: Model,
    decision: Annotated[
        str,
        typer.Argument(
            help="adapt: the robot has changed, what was learnt before counts less; ignore: go on as before.",
            autocompletion=lambda: list(DECISIONS),
        ),
    ],
    replay: Annotated[bool, typer.Option("--replay", help="Also learn the rows that were kept out since.")] = False,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """End a hold: say what a change of the robot, or a stream that did not fit, means."""
    if decision not in DECISIONS:
        raise CommandError(f"decision is {decision!r}, expected {' or '.join(DECISIONS)}")
    with connected(url) as client:
        decided = client.decide(model, cast(Literal["adapt", "ignore"], decision), replay)
    print_result(decided, as_json, f"{model} learns again; {counted(decided.rows, 'row')} of those kept out learnt")


@alarms_app.command()
def alarms(model: Model, limit: Limit = 20, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """List what the owner of a model should know: changes, payloads, motion beyond what is known; newest first."""
    with connected(url) as client:
        found = list(islice(client.alarms(model), limit))
    if as_json:
        print_json(found)
        return
    if not found:
        echo(f"no alarm of {model}")
    for each in found:
        echo(f"{each.at[:19].replace('T', ' ')}  {each.kind}: {each.message}")

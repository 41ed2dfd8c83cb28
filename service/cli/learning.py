"""`lipserve learning` and `lipserve alarms`: where the learning of a model stands, and what its owner decides."""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, Annotated, Literal, cast

import typer
from rich.markup import escape
from rich.table import Table

from lipserve.address import DEFAULT_URL
from service.cli.connecting import connected
from service.cli.consoles import CommandError, echo, note, out, print_json, print_result
from service.cli.options import Json, Limit, Model, Url, Yes, alone, confirm, group, pairs, value
from service.foundation.text import counted

if TYPE_CHECKING:
    from lipserve.records.learning import Quality

app = group("How a model learns: show and set it, decide about a change, look at batches, take them back, learn them.")
alarms_app = alone()
DECISIONS = ("adapt", "ignore")
StreamId = Annotated[str, typer.Argument(help="The batch's stream.")]
Sequence = Annotated[int, typer.Argument(help="The batch's sequence.", min=0)]


@app.command()
def show(model: Model, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Print whether a model learns, from which streams, what it waits for, and how well it predicted lately."""
    with connected(url) as client:
        learning, quality = client.learning(model), client.quality(model)
    if as_json:
        print_json({"learning": learning, "quality": quality})
        return
    at = learning.status
    state = "is paused" if not learning.options.enabled else "is held" if at.held is not None else "goes on"
    echo(f"{model} version {at.version}, revision {at.published} of {at.revision}: learning {state}")
    if at.lag_rows:
        echo(f"  not learnt yet: {counted(at.lag_rows, 'row')}, the first since {at.lag_s:.1f} s")
    if at.held is not None:
        evidence = at.held.evidence
        echo(f"  since {evidence.get('cause') or evidence.get('kind', 'a change')}: {', '.join(evidence['joints'])}")
        note(f"`lipserve learning decide {model} adapt` or `ignore` ends it")
    if at.failure is not None:
        echo(f"  fails: {at.failure}")
    if at.streams:
        table = Table("stream", "sends", "last sequence", "last at", "missing", title="streams")
        for each in at.streams:
            last_at = "" if each.last_at is None else each.last_at[:19].replace("T", " ")
            table.add_row(escape(each.stream_id), each.kind, str(each.last), last_at, str(each.missing))
        out.print(table)
    _print_quality(quality)


def _print_quality(quality: Quality) -> None:
    """How rows were predicted before they were learnt, over the longest window that any have come in."""
    from service.cli.tables import figures_table  # noqa: PLC0415 - takes long to import; help needs none

    seen = max(quality.windows, key=lambda each: (each.rows > 0, each.seconds))
    if not seen.rows:
        echo(f"nothing has come in the last {seen.seconds:.0f} s")
        return
    title = f"{counted(seen.rows, 'row')} of the last {seen.seconds:.0f} s, each predicted before it was learnt"
    figures = {"nmse": seen.nmse, "rmse": seen.rmse, "coverage": seen.coverage, "nlpd": seen.nlpd}
    out.print(figures_table(title, quality.joint_names, figures))


@app.command("set")
def set_(
    model: Model,
    option: Annotated[
        list[str],
        typer.Argument(help="What to change, as forgetting_s=3600 or on_change=adapt; null switches a time off."),
    ],
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Set how a model learns; what is not named stays. Options: `lipserve learning show MODEL --json`."""
    chosen = {name: value(text) for name, text in pairs("an option", option).items()}
    with connected(url) as client:
        learning = client.set_learning(model, **chosen)
    options = ", ".join(f"{name} = {each}" for name, each in learning.options.as_dict().items() if name in chosen)
    print_result(learning, as_json, f"{model} learns with {options}")


@app.command()
def refresh(model: Model, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Queue a job that trains the serving version anew, on its recordings and all that was observed since."""
    with connected(url) as client:
        job = client.refresh(model)
    print_result(job, as_json, f"{job.id} is queued: `lipserve jobs follow {job.id}`")


@app.command()
def batches(
    model: Model,
    stream: Annotated[str | None, typer.Option(help="Only those of this stream.")] = None,
    rejected: Annotated[bool, typer.Option("--rejected", help="Only those with rows that were kept out.")] = False,
    limit: Limit = 20,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """List the batches of a model's log, newest first, with what became of their rows."""
    with connected(url) as client:
        batches_of_log = list(islice(client.observations(model, stream, rejected), limit))
    if as_json:
        print_json(batches_of_log)
        return
    if not batches_of_log:
        echo(f"no batch of {model}")
        return
    table = Table("stream", "sequence", "received", "state", "rows", "learnt", "kept out")
    for each in batches_of_log:
        out_ = ", ".join(f"{count} {code}" for code, count in each.rejected.items()) or "-"
        at = each.received_at[:19].replace("T", " ")
        figures = (str(each.rows), str(each.accepted), out_)
        table.add_row(escape(each.stream_id), str(each.sequence), at, each.state, *figures)
    out.print(table)


@app.command()
def batch(
    model: Model,
    stream: StreamId,
    sequence: Sequence,
    rows: Annotated[bool, typer.Option("--rows", help="With --json: also its rows, each with its code.")] = False,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Print what became of one batch, and how well it was predicted."""
    with connected(url) as client:
        seen = client.observation(model, stream, sequence, rows and as_json)
    kept = ", ".join(f"{count} {code}" for code, count in seen.rejected.items()) or "none"
    lines = [
        f"{stream} {sequence} to {seen.last_sequence}: {seen.state}, {seen.accepted} of {seen.rows} rows teach",
        f"  kept out: {kept}",
        *(
            f"  {each.replayed_at[:19].replace('T', ' ')}  {counted(each.rows, 'row')} replayed"
            for each in seen.replays
        ),
    ]
    print_result(seen, as_json, *lines)


@app.command()
def unlearn(
    model: Model, stream: StreamId, sequence: Sequence, yes: Yes = False, url: Url = DEFAULT_URL, as_json: Json = False
) -> None:
    """Take what a batch has taught out of what is learnt, exactly. It stays in the log."""
    confirm(f"unlearn batch {sequence} of stream {stream}?", yes)
    with connected(url) as client:
        done = client.unlearn(model, stream, sequence)
    print_result(done, as_json, f"batch {sequence} of {stream} is unlearnt: revision {done.revision}")


@app.command()
def forget(model: Model, stream: StreamId, yes: Yes = False, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Delete a stream: its payload, its clock, and how wide its intervals are. What it has taught stays learnt."""
    confirm(f"delete stream {stream} of {model}?", yes)
    with connected(url) as client:
        client.delete_stream(model, stream)
    print_result({"stream_id": stream}, as_json, f"stream {stream} of {model} is deleted")


@app.command()
def replay(
    model: Model,
    stream: StreamId,
    sequence: Sequence,
    code: Annotated[list[str] | None, typer.Option(help="Only rows with this code; repeat. All by default.")] = None,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Learn rows of a batch after all that were kept out, such as contacts."""
    with connected(url) as client:
        done = client.replay(model, stream, sequence, code)
    print_result(done, as_json, f"learnt now: {counted(done.rows, 'row')} of batch {sequence} of {stream}")


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
    print_result(
        decided, as_json, f"{model} learns again; of what was kept out {counted(decided.rows, 'row')} learnt now"
    )


@alarms_app.command()
def alarms(model: Model, limit: Limit = 20, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """List what the owner of a model should know: changes, payloads, motion beyond what is known; newest first."""
    with connected(url) as client:
        newest = list(islice(client.alarms(model), limit))
    if as_json:
        print_json(newest)
        return
    if not newest:
        echo(f"no alarm of {model}")
    for each in newest:
        echo(f"{each.at[:19].replace('T', ' ')}  {each.kind}: {each.message}")

"""`lipserve learning` and `lipserve alarms`: state and control of online learning."""

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

app = group("Show and control online learning: options, pauses, observation batches.")
alarms_app = alone()
DECISIONS = ("adapt", "ignore")
StreamId = Annotated[str, typer.Argument(help="stream_id of the stream.")]
Sequence = Annotated[int, typer.Argument(help="Sequence of the batch.", min=0)]


@app.command()
def show(model: Model, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Print the state of learning, the streams, a pending decision, and recent prediction errors."""
    with connected(url) as client:
        learning, quality = client.learning(model), client.quality(model)
    if as_json:
        print_json({"learning": learning, "quality": quality})
        return
    at = learning.status
    state = "active" if at.held is None else "paused until you decide"
    state = state if learning.options.enabled else "paused"
    echo(f"{model} version {at.version}, revision {at.published} of {at.revision}: learning is {state}")
    if at.lag_rows:
        echo(f"  not learnt yet: {counted(at.lag_rows, 'row')}, oldest {at.lag_s:.1f} s old")
    if at.held is not None:
        evidence = at.held.evidence
        cause = evidence.get("cause") or evidence.get("kind", "a change")
        echo(f"  paused ({cause}): {', '.join(evidence['joints'])}")
        note(f"`lipserve learning decide {model} adapt` (or `ignore`) resumes learning")
    if at.failure is not None:
        echo(f"  learning fails: {at.failure}")
    if at.streams:
        table = Table("stream", "kind", "last sequence", "last at", "missing", title="streams")
        for each in at.streams:
            last_at = "" if each.last_at is None else each.last_at[:19].replace("T", " ")
            table.add_row(escape(each.stream_id), each.kind, str(each.last), last_at, str(each.missing))
        out.print(table)
    _print_quality(quality)


def _print_quality(quality: Quality) -> None:
    """Print prediction errors of rows before they were learnt, over the longest window that has rows."""
    from service.cli.tables import quality_table  # noqa: PLC0415 - slow import, not needed for help

    seen = max(quality.windows, key=lambda each: (each.rows > 0, each.seconds))
    if not seen.rows:
        echo(f"no rows received in the last {seen.seconds:.0f} s")
        return
    echo(f"{quality.verdict.label}: {quality.verdict.reason} {quality.verdict.action}")
    title = f"prediction of {counted(seen.rows, 'row')} of the last {seen.seconds:.0f} s, before learning from them"
    out.print(quality_table(title, quality.joint_names, seen))


@app.command("set")
def set_(
    model: Model,
    option: Annotated[
        list[str],
        typer.Argument(help="Options to change, e.g. forgetting_s=3600 or on_change=adapt; null disables a time."),
    ],
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Set learning options of a model; others keep their values. List: `lipserve learning show MODEL --json`."""
    chosen = {name: value(text) for name, text in pairs("an option", option).items()}
    with connected(url) as client:
        learning = client.set_learning(model, **chosen)
    options = ", ".join(f"{name} = {each}" for name, each in learning.options.as_dict().items() if name in chosen)
    print_result(learning, as_json, f"{model}: {options}")


@app.command()
def refresh(model: Model, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Queue a job that retrains the serving version on its recordings and all observations since."""
    with connected(url) as client:
        job = client.refresh(model)
    print_result(job, as_json, f"{job.id} is queued: `lipserve jobs follow {job.id}`")


@app.command()
def batches(
    model: Model,
    stream: Annotated[str | None, typer.Option(help="Only batches of this stream.")] = None,
    rejected: Annotated[bool, typer.Option("--rejected", help="Only batches with rejected rows.")] = False,
    limit: Limit = 20,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """List the observation batches of a model, newest first, with learnt and rejected rows."""
    with connected(url) as client:
        batches_of_log = list(islice(client.observations(model, stream, rejected), limit))
    if as_json:
        print_json(batches_of_log)
        return
    if not batches_of_log:
        echo(f"no batches of {model}")
        return
    table = Table("stream", "sequence", "received", "state", "rows", "learnt", "rejected")
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
    rows: Annotated[bool, typer.Option("--rows", help="With --json: also print the rows with their codes.")] = False,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Print the state of an observation batch, its rejected rows and replays."""
    with connected(url) as client:
        seen = client.observation(model, stream, sequence, rows and as_json)
    kept = ", ".join(f"{count} {code}" for code, count in seen.rejected.items()) or "none"
    lines = [
        f"{stream} {sequence} to {seen.last_sequence}: {seen.state}, {seen.accepted} of {seen.rows} rows accepted",
        f"  rejected: {kept}",
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
    """Remove the effect of a batch from the model exactly. The batch stays in the log."""
    confirm(f"Unlearn batch {sequence} of stream {stream}?", yes)
    with connected(url) as client:
        done = client.unlearn(model, stream, sequence)
    print_result(done, as_json, f"batch {sequence} of {stream} unlearnt: revision {done.revision}")


@app.command()
def forget(model: Model, stream: StreamId, yes: Yes = False, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Delete a stream's state: its payload, clock and interval widths. The model keeps what it learnt from it."""
    confirm(f"Delete stream {stream} of {model}?", yes)
    with connected(url) as client:
        client.delete_stream(model, stream)
    print_result({"stream_id": stream}, as_json, f"stream {stream} of {model} deleted")


@app.command()
def replay(
    model: Model,
    stream: StreamId,
    sequence: Sequence,
    code: Annotated[list[str] | None, typer.Option(help="Only rows with this code. Repeatable. Default: all.")] = None,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Learn rejected rows of a batch, for example those marked as contacts."""
    with connected(url) as client:
        done = client.replay(model, stream, sequence, code)
    print_result(done, as_json, f"learnt {counted(done.rows, 'row')} of batch {sequence} of {stream}")


@app.command()
def decide(
    model: Model,
    decision: Annotated[
        str,
        typer.Argument(
            help="adapt: the robot has changed, so reduce the weight of earlier data; ignore: resume as before.",
            autocompletion=lambda: list(DECISIONS),
        ),
    ],
    replay: Annotated[
        bool, typer.Option("--replay", help="Also learn the rows that were rejected during the pause.")
    ] = False,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Resume paused learning: decide how to handle a change of the robot or a stream that does not fit."""
    if decision not in DECISIONS:
        raise CommandError(f"the decision must be {' or '.join(DECISIONS)}, got {decision!r}")
    with connected(url) as client:
        decided = client.decide(model, cast(Literal["adapt", "ignore"], decision), replay)
    print_result(decided, as_json, f"{model}: learning resumed; {counted(decided.rows, 'rejected row')} learnt")


@alarms_app.command()
def alarms(model: Model, limit: Limit = 20, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """List alarms of a model, newest first: changes, payloads, motion outside the training data."""
    with connected(url) as client:
        newest = list(islice(client.alarms(model), limit))
    if as_json:
        print_json(newest)
        return
    if not newest:
        echo(f"no alarms of {model}")
    for each in newest:
        echo(f"{each.at[:19].replace('T', ' ')}  {each.kind}: {each.message}")

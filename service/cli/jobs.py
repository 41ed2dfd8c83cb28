"""`lipserve jobs` and `lipserve train`: what is trained, was trained, or failed to be."""

from __future__ import annotations

from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.markup import escape
from rich.table import Column, Table

from lipcore.vocabulary import AUTO, ESTIMATOR_CHOICES
from lipserve.address import DEFAULT_URL
from service.cli import connecting
from service.cli.connecting import PATIENCE, connected, dataset_of, recording_of, watch
from service.cli.consoles import INTERRUPTED, CommandError, echo, note, out, print_json
from service.cli.models import print_held_out, print_promotion, print_selection
from service.cli.options import HELD_OUT_BY, JobId, Json, Limit, Promotion, Url, alone, group, names, pairs, value
from service.foundation.text import percent

if TYPE_CHECKING:
    from lipserve.records.jobs import Job


Patience = Annotated[
    float, typer.Option(min=0, help="Longest wait for a service that is away, s: the job goes on when it is back.")
]

app = group("Training jobs: list, show, follow, cancel and retry them.")


@app.command("list")
def list_(limit: Limit = 50, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """List jobs, newest first."""
    with connected(url) as client:
        jobs = list(islice(client.jobs(), limit))
    if as_json:
        print_json(jobs)
        return
    if not jobs:
        echo("no job yet: `lipserve train FILE --model NAME` queues one")
        return
    from service.cli.tables import judged  # noqa: PLC0415 - takes long to import; help needs none

    figures = ("nMSE held out", "in 95 %")
    table = Table(Column("id", no_wrap=True), "model", "estimator", "state", "done", "version", *figures, "queued")
    for job in jobs:
        version = "-" if job.version is None else str(job.version)
        at = job.created_at[:16].replace("T", " ")
        cells = (job.estimator, job.state, percent(job.progress.fraction), version, *judged(job.quality), at)
        table.add_row(job.id, escape(job.model), *cells)
    out.print(table)


@app.command()
def show(job: JobId, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Print a job: how far it is, and what happened to it."""
    with connected(url) as client:
        _print(client.job(job), as_json)


@app.command()
def cancel(job: JobId, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Cancel a job that waits or runs."""
    with connected(url) as client:
        _print(client.cancel(job), as_json)


@app.command()
def retry(job: JobId, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Queue a new job that repeats one that failed or was cancelled."""
    with connected(url) as client:
        _print(client.retry(job), as_json)


@app.command()
def follow(job: JobId, patience: Patience = PATIENCE, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Show a job's progress until it ends, also over a restart of the service; Ctrl-C stops watching, and the job goes
    on."""
    with connected(url) as client:
        ended, interrupted = watch(client, client.job(job), cancels=False, patience=patience)
    _print(ended, as_json)
    if interrupted:
        note(f"{ended.id} goes on: `lipserve jobs cancel {ended.id}` ends it")
        raise typer.Exit(INTERRUPTED)
    if ended.state != "succeeded":
        raise CommandError(f"{ended.id} has {ended.state}" + (f": {ended.error.message}" if ended.error else ""))


def _print(job: Job, as_json: bool) -> None:
    if as_json:
        print_json(job)
        return
    made = "" if job.version is None else f", version {job.version}"
    echo(f"{job.id}  {job.model} ({job.estimator}): {job.state}{made}")
    at = job.progress
    left = "" if not at.remaining_s else f", at most about {at.remaining_s:.0f} s left"
    echo(f"  {at.stage}, {percent(at.fraction)} after {at.elapsed_s:.0f} s{left}; data sets {', '.join(job.datasets)}")
    for change in job.history:
        echo(f"  {change.at[:19].replace('T', ' ')}  {change.state}: {change.message}")
    if job.error is not None:
        echo(f"  failed: {job.error.message} ({job.error.code})")


train_app = alone()


@train_app.command()
def train(
    data: Annotated[
        list[str],
        typer.Argument(
            help="Recordings, which are uploaded, and ids or names of data sets.", autocompletion=connecting.datasets
        ),
    ],
    model: Annotated[
        str, typer.Option(help="Name of the model; a new version of it is made.", autocompletion=connecting.models)
    ],
    url: Url = DEFAULT_URL,
    estimator: Annotated[
        str | None,
        typer.Option(
            help=f"One of {', '.join(ESTIMATOR_CHOICES)}; {AUTO} by default, which compares arms and `lip-chain` "
            "on held-out rows and takes the simplest unless another one is surely better.",
            autocompletion=lambda: list(ESTIMATOR_CHOICES),
        ),
    ] = None,
    joint_types: Annotated[
        str | None, typer.Option(help="One a joint, separated by commas; all revolute by default.")
    ] = None,
    robot: Annotated[
        str | None, typer.Option(help="Of rigid bodies: a profile such as panda, the id of a URDF, or a .urdf file.")
    ] = None,
    base: Annotated[
        str | None,
        typer.Option(
            help="Of rigid bodies: a version of another unit of the same robot to start from, as MODEL:3, MODEL@ALIAS "
            "or MODEL.",
            autocompletion=connecting.models,
        ),
    ] = None,
    prior: Annotated[
        str | None,
        typer.Option(help="Of rigid bodies: around the parameters of the `urdf` (default) or around `zero`."),
    ] = None,
    option: Annotated[
        list[str] | None,
        typer.Option(help="How to fit, as max_iterations=100: see `options` of POST /v1/jobs; repeat."),
    ] = None,
    hold_out: Annotated[
        float | None,
        typer.Option(help="Share of the samples to hold out and evaluate the model on; 0.3 by default, 0 for nothing."),
    ] = None,
    hold_out_by: Annotated[
        str | None,
        typer.Option(
            help="What is held out: the `last` part, whole `episodes`, some of ten `blocks`; or `auto` (default), the "
            "last part, unless that repeats what is trained on and other motion does not.",
            autocompletion=lambda: HELD_OUT_BY,
        ),
    ] = None,
    hold_out_only: Annotated[
        bool,
        typer.Option(
            "--hold-out-only",
            help="Never learn what is held out. By default the version is judged without it, then trained on all rows.",
        ),
    ] = False,
    promotion: Promotion = None,
    patience: Patience = PATIENCE,
    wait: Annotated[bool, typer.Option(help="Wait for the job's end; --no-wait leaves it to `lipserve jobs`.")] = True,
    as_json: Json = False,
) -> None:
    """Upload recordings and train a model on them. Ctrl-C cancels the job."""
    # the client takes long to import; help needs none
    from lipserve.call import new_key  # noqa: PLC0415

    options: dict[str, Any] = {name: value(text) for name, text in pairs("--option", option).items()}
    if prior is not None:
        options["prior"] = prior
    urdf = None if robot is None or not robot.endswith(".urdf") else Path(robot)
    if urdf is not None and not urdf.is_file():
        raise CommandError(f"--robot is {robot!r}, expected a profile such as panda, the id of a URDF, or a .urdf file")
    request = {
        "estimator": estimator,
        "joint_types": names(joint_types),
        "options": options or None,
        "robot": robot if urdf is None else None,
        "holdout": _holdout(hold_out, hold_out_by, hold_out_only),
        "base": base,
        "promotion": promotion,
    }
    with connected(url) as client:
        there = [each for each in data if recording_of(each) is None]
        client.check_training(model, there if len(there) == len(data) else (), **request)  # type: ignore[arg-type]
        for each in there:
            client.dataset(each)
        datasets = [dataset_of(client, each) for each in data]
        if urdf is not None:
            request["robot"] = client.upload_robot(urdf).id
        queue = partial(client.train, model, datasets, **request, idempotency_key=new_key())  # type: ignore[arg-type]
        try:
            job = queue()
        except KeyboardInterrupt:
            client.cancel(queue().id)  # the same job, whether the first request has arrived or not
            raise
        interrupted = False
        if wait:
            note(f"{job.id} is queued: `lipserve jobs follow {job.id}` follows it, too")
            job, interrupted = watch(client, job, cancels=True, patience=patience)
        made = None if job.version is None else client.version(model, job.version)
    if as_json:
        print_json(job)
    if interrupted and job.version is None:
        note(f"{job.id} is cancelled")
        raise typer.Exit(INTERRUPTED)
    if wait and job.version is None:
        message = f"{job.id} has {job.state}" + (f": {job.error.message}" if job.error else "")
        raise CommandError(message, f"`lipserve jobs show {job.id}` tells its history")
    if as_json:
        return
    if not wait:
        echo(f"{job.id} is queued: `lipserve jobs follow {job.id}`")
        return
    if made is None:
        return
    judged = made.promotion
    waits = judged is not None and not judged.answers
    echo(f"{model} version {job.version} is trained and {'waits as candidate' if waits else 'answers'}")
    if made.selection is not None:
        print_selection(made.selection)
    if made.lineage.get("holdout") is not None:
        print_held_out(made)
    print_promotion(made)
    if waits:
        note(f"`lipserve models promote {model} {job.version}` lets it answer all the same")


def _holdout(share: float | None, kind: str | None, only: bool) -> dict[str, Any] | Literal[False] | None:
    """The `holdout` of a request to train: False for nothing, None for the service's default; raise CommandError."""
    if share == 0:
        if only:
            raise CommandError("--hold-out-only needs rows that are held out: set --hold-out above 0, or leave it out")
        return False
    given = (("share", share), ("kind", kind), ("only", only or None))
    return {name: value for name, value in given if value is not None} or None

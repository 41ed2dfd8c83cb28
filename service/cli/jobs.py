"""`lipserve jobs` and `lipserve train`."""

from __future__ import annotations

from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.markup import escape
from rich.table import Column, Table

from lipcore.vocabulary import AUTO, ESTIMATOR_CHOICES
from lipserve.address import DEFAULT_URL
from service.cli import connecting
from service.cli.connecting import PATIENCE, connected, dataset_of, recording_of, robot_of, urdf_of, watch
from service.cli.consoles import INTERRUPTED, CommandError, echo, note, out, print_json, print_warnings
from service.cli.options import HELD_OUT_BY, JobId, Json, Limit, Promotion, Url, alone, group, names, pairs, value
from service.cli.versions import print_judged, print_selection
from service.foundation.text import percent

if TYPE_CHECKING:
    from lipserve.records.jobs import Job


Patience = Annotated[
    float,
    typer.Option(min=0, help="Max time to wait for an unreachable service, s. The job continues when it is back."),
]

app = group("List, show, follow, cancel and retry training jobs.")


@app.command("list")
def list_(limit: Limit = 50, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """List jobs, newest first."""
    with connected(url) as client:
        jobs = list(islice(client.jobs(), limit))
    if as_json:
        print_json(jobs)
        return
    if not jobs:
        echo("no jobs yet: `lipserve train FILE --model NAME` queues one")
        return
    from service.cli.tables import verdict_cells  # noqa: PLC0415 - takes long to import; help needs none

    figures = ("held-out nMSE", "coverage")
    table = Table(Column("id", no_wrap=True), "model", "estimator", "state", "done", "version", *figures, "queued")
    for job in jobs:
        version = "-" if job.version is None else str(job.version)
        at = job.created_at[:16].replace("T", " ")
        cells = (job.estimator, job.state, percent(job.progress.fraction), version, *verdict_cells(job.verdict), at)
        table.add_row(job.id, escape(job.model), *cells)
    out.print(table)


@app.command()
def show(job: JobId, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Print a job with its progress and history."""
    with connected(url) as client:
        _print(client.job(job), as_json)


@app.command()
def cancel(job: JobId, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Cancel a queued or running job."""
    with connected(url) as client:
        _print(client.cancel(job), as_json)


@app.command()
def retry(job: JobId, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Queue a failed or cancelled job again, as a new job."""
    with connected(url) as client:
        _print(client.retry(job), as_json)


@app.command()
def follow(job: JobId, patience: Patience = PATIENCE, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Show a job's progress until it ends, even if the service restarts.

    Ctrl-C stops watching; the job continues.
    """
    with connected(url) as client:
        ended, interrupted = watch(client, client.job(job), cancels=False, patience=patience)
    _print(ended, as_json)
    if interrupted:
        note(f"{ended.id} continues: `lipserve jobs cancel {ended.id}` cancels it")
        raise typer.Exit(INTERRUPTED)
    if ended.state != "succeeded":
        raise CommandError(f"{ended.id}: {ended.state}" + (f": {ended.error.message}" if ended.error else ""))


def _print(job: Job, as_json: bool) -> None:
    if as_json:
        print_json(job)
        return
    made = "" if job.version is None else f", version {job.version}"
    echo(f"{job.id}  {job.model} ({job.estimator}): {job.state}{made}")
    at = job.progress
    left = "" if not at.remaining_s else f", up to {at.remaining_s:.0f} s left"
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
        typer.Argument(help="Recordings to upload, or ids or names of data sets.", autocompletion=connecting.datasets),
    ],
    model: Annotated[
        str, typer.Option(help="Name of the model. The job adds a version.", autocompletion=connecting.models)
    ],
    url: Url = DEFAULT_URL,
    estimator: Annotated[
        str | None,
        typer.Option(
            help=f"One of {', '.join(ESTIMATOR_CHOICES)}. Default: {AUTO}, which compares rigid-body estimators and "
            "`lip-chain` on held-out rows and selects the simplest unless another is significantly better.",
            autocompletion=lambda: list(ESTIMATOR_CHOICES),
        ),
    ] = None,
    joint_types: Annotated[
        str | None,
        typer.Option(
            help="One joint type per joint, separated by commas. Default: those of the data's robot, else revolute."
        ),
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option(
            help="Robot for rigid-body estimators: a profile such as panda, the id of a URDF, a .urdf file, or none. "
            "Default: the robot of the recordings."
        ),
    ] = None,
    base: Annotated[
        str | None,
        typer.Option(
            help="Version of another unit of the same robot to start from, for rigid-body estimators: MODEL@3, "
            "MODEL@ALIAS or MODEL.",
            autocompletion=connecting.models,
        ),
    ] = None,
    prior: Annotated[
        str | None,
        typer.Option(help="Mean of the prior of rigid-body parameters: `urdf` (default) or `zero`."),
    ] = None,
    option: Annotated[
        list[str] | None,
        typer.Option(help="Fit option, e.g. max_iterations=100 (see `options` of POST /v1/jobs). Repeatable."),
    ] = None,
    hold_out: Annotated[
        float | None,
        typer.Option(help="Share of the samples to hold out for evaluation. Default: 0.3; 0 disables it."),
    ] = None,
    hold_out_by: Annotated[
        str | None,
        typer.Option(
            help="Part to hold out: the `last` part, whole `episodes`, or some of ten `blocks`. Default: `auto`, the "
            "last part, unless it repeats the training motion and other parts do not.",
            autocompletion=lambda: HELD_OUT_BY,
        ),
    ] = None,
    hold_out_only: Annotated[
        bool,
        typer.Option(
            "--hold-out-only",
            help="Never train on the held-out part. Default: evaluate without it, then train on all rows.",
        ),
    ] = False,
    promotion: Promotion = None,
    patience: Patience = PATIENCE,
    wait: Annotated[bool, typer.Option(help="Wait for the job to end. With --no-wait, use `lipserve jobs`.")] = True,
    as_json: Json = False,
) -> None:
    """Upload recordings and train a model on them. Ctrl-C cancels the job."""
    # slow import, not needed for help
    from lipserve.call import new_key  # noqa: PLC0415

    options: dict[str, Any] = {name: value(text) for name, text in pairs("--option", option).items()}
    if prior is not None:
        options["prior"] = prior
    urdf = urdf_of(robot)
    request = {
        "estimator": estimator,
        "joint_types": names(joint_types),
        "options": options or None,
        "robot": False if robot == "none" else robot if urdf is None else None,
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
            request["robot"] = robot_of(client, str(urdf))
        queue = partial(client.train, model, datasets, **request, idempotency_key=new_key())  # type: ignore[arg-type]
        try:
            job = queue()
        except KeyboardInterrupt:
            client.cancel(queue().id)  # same idempotency key: the same job even if the first request was lost
            raise
        interrupted = False
        if wait:
            note(f"{job.id} is queued: `lipserve jobs follow {job.id}` also follows it")
            job, interrupted = watch(client, job, cancels=True, patience=patience)
        made = None if job.version is None else client.version(model, job.version)
    if as_json:
        print_json(job)
    if interrupted and job.version is None:
        note(f"{job.id} is cancelled")
        raise typer.Exit(INTERRUPTED)
    if wait and job.version is None:
        message = f"{job.id}: {job.state}" + (f": {job.error.message}" if job.error else "")
        raise CommandError(message, f"`lipserve jobs show {job.id}` shows its history")
    if as_json:
        return
    if not wait:
        echo(f"{job.id} is queued: `lipserve jobs follow {job.id}`")
        return
    if made is None:
        return
    check = made.promotion
    waits = check is not None and not check.answers
    echo(f"{model} version {job.version} trained: {'candidate, not serving' if waits else 'now serving'}")
    if made.selection is not None:
        print_selection(made.selection)
    print_judged(made)
    print_warnings(made.warnings)
    if waits:
        forced = "" if made.verdict.serves else " --override"
        note(f"`lipserve models promote {model} {job.version}{forced}` makes it the serving version")


def _holdout(share: float | None, kind: str | None, only: bool) -> dict[str, Any] | Literal[False] | None:
    """Return `holdout` of a training request: False for none, None for the service's default; raise CommandError."""
    if share == 0:
        if only:
            raise CommandError("--hold-out-only needs held-out rows", "set --hold-out above 0, or omit it")
        return False
    given = (("share", share), ("kind", kind), ("only", only or None))
    return {name: value for name, value in given if value is not None} or None

"""`lipserve jobs`: what is trained, was trained, or failed to be."""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING

import typer
from rich.markup import escape
from rich.table import Column, Table

from service.cli.connecting import connected, watch
from service.cli.consoles import INTERRUPTED, CommandError, note, out, print_json, say
from service.cli.options import JobId, Json, Limit, Url, group
from service.foundation.settings import DEFAULT_URL

if TYPE_CHECKING:
    from service.training.schema import Job

app = group("Training jobs: list, show, follow, cancel and retry them.")


@app.command("list")
def list_(
    limit: Limit = 50,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """List jobs, newest first."""
    with connected(url) as client:
        jobs = list(islice(client.jobs(), limit))
    if as_json:
        print_json(jobs)
        return
    if not jobs:
        say("no job yet: `lipserve train FILE --model NAME` queues one")
        return
    table = Table(Column("id", no_wrap=True), "model", "estimator", "state", "done", "version", "queued")
    for job in jobs:
        version = "-" if job.version is None else str(job.version)
        at = job.created_at[:16].replace("T", " ")
        table.add_row(job.id, escape(job.model), job.estimator, job.state, f"{job.progress.fraction:.0%}", version, at)
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
def follow(job: JobId, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Show a job's progress until it ends; Ctrl-C stops watching, and the job goes on."""
    with connected(url) as client:
        ended, interrupted = watch(client, client.job(job), cancels=False)
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
    say(f"{job.id}  {job.model} ({job.estimator}): {job.state}{made}")
    at = job.progress
    left = "" if not at.remaining_s else f", at most about {at.remaining_s:.0f} s left"
    say(f"  {at.stage}, {at.fraction:.0%} after {at.elapsed_s:.0f} s{left}; data sets {', '.join(job.datasets)}")
    for change in job.history:
        say(f"  {change.at[:19].replace('T', ' ')}  {change.state}: {change.message}")
    if job.error is not None:
        say(f"  failed: {job.error.message} ({job.error.code})")

"""A client of the service for a command: what the service refuses is shown with what to do about it, and a training job
is watched until it ends."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPException
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.cli.completion import ask
from service.cli.consoles import START, CommandError, Explained, err, explain, note

if TYPE_CHECKING:
    from service.client import Client
    from service.training.schema import Job

DATASET = re.compile(r"ds_\w+")
MOST_NAMES = 20
"""Models that a hint lists, at most."""


@contextmanager
def connected(url: str) -> Iterator[Client]:
    """A client of the service at `url`; raise CommandError with a hint where it refuses or is not there."""
    # takes long to import, and help needs none of it
    from service.client import ApiError, Client, ServiceUnreachableError  # noqa: PLC0415
    from service.stream.exchange import StreamError  # noqa: PLC0415

    try:
        with Client(url) as client:
            yield client
    except (ApiError, StreamError) as error:
        refusal = explain(error, (ApiError, StreamError)) or Explained(str(error))
        raise CommandError(refusal.message, refusal.hint or _existing(url, str(error))) from error
    except ServiceUnreachableError as error:
        raise CommandError(str(error), None if "lipserve serve" in str(error) else START) from error


def dataset_of(client: Client, data: str, **reading: Any) -> str:
    """Return the id of a data set: one that is given, or that of a recording, which is uploaded."""
    path = Path(data)
    if DATASET.fullmatch(data) and not path.exists():
        return data
    if not path.is_file():
        raise CommandError(
            f"data is {data!r}, expected a recording or the id of a data set",
            "`lipserve data list` shows the data sets that exist",
        )
    dataset = client.upload(path, progress=True, **reading)
    note(f"{path.name} is uploaded as {dataset.id}")
    return dataset.id


def _existing(url: str, message: str) -> str | None:
    """What there is instead of what was not found."""
    if message.startswith("no model"):
        try:
            names = [each["name"] for each in ask(url, f"/v1/models?limit={MOST_NAMES}")["items"]]
        except (OSError, HTTPException, ValueError, KeyError):  # a hint is no reason to fail otherwise
            return None
        return (
            f"models that exist: {', '.join(names)}" if names else "there is no model yet: `lipserve train` makes one"
        )
    return next((hint for start, hint in _LISTS.items() if message.startswith(start)), None)


_LISTS = {
    "no dataset": "`lipserve data list` shows the data sets that exist",
    "no job": "`lipserve jobs list` shows the jobs that exist",
    "no version": "`lipserve models show MODEL` shows the versions that exist",
    "no alias": "`lipserve models show MODEL` shows the aliases that exist",
}


def watch(client: Client, job: Job, cancels: bool) -> tuple[Job, bool]:
    """Show a job's progress on standard error until it ends; return it, and whether Ctrl-C ended the watching.

    cancels: Ctrl-C cancels the job and waits for its end, a second one does not wait; else the job goes on.
    """
    from service.client.progress import job_bar  # noqa: PLC0415 - takes long to import; help needs none

    try:
        with job_bar(err) as show:
            return client.wait(job.id, show), False
    except KeyboardInterrupt:
        if not cancels:
            return client.job(job.id), True
        note(f"cancelling job {job.id} …")
        client.cancel(job.id)
        return client.wait(job.id), True

"""A training job, watched in a terminal until it ends."""

from __future__ import annotations

from service.cli.consoles import err, note
from service.client import Client
from service.client.progress import job_bar
from service.training.schema import Job


def watch(client: Client, job: Job, cancels: bool) -> tuple[Job, bool]:
    """Show a job's progress on standard error until it ends; return it, and whether Ctrl-C ended the watching.

    cancels: Ctrl-C cancels the job and waits for its end, a second one does not wait; else the job goes on.
    """
    try:
        with job_bar(err) as show:
            return client.wait(job.id, show), False
    except KeyboardInterrupt:
        if not cancels:
            return client.job(job.id), True
        note(f"cancelling job {job.id} …")
        client.cancel(job.id)
        return client.wait(job.id), True

"""Progress of a training job in a terminal."""

from __future__ import annotations

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from service.client import Client
from service.training.schema import Job
from service.training.states import ACTIVE

PLAIN_EVERY = 5.0
"""Seconds between two lines where the console is no terminal."""


def follow(client: Client, job: Job, console: Console) -> Job:
    """Show a job's progress until it ends; Ctrl-C cancels it. Return the job as it ended."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
    )
    printed = -PLAIN_EVERY
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("waiting", total=1.0)

        def show(seen: Job) -> None:
            nonlocal printed
            at = seen.progress
            objective = "" if at.objective is None else f" objective {at.objective:.1f}"
            text = f"{at.stage} {at.iteration}/{at.max_iterations}{objective}" if at.iteration else at.stage
            if at.remaining_s:
                text += f", at most about {at.remaining_s:.0f} s left"
            bar.update(task, description=text, completed=at.fraction)
            if not console.is_terminal and (at.elapsed_s - printed >= PLAIN_EVERY or seen.state not in ACTIVE):
                printed = at.elapsed_s
                console.print(f"  {at.elapsed_s:5.1f} s  {at.fraction:4.0%}  {text}", highlight=False)

        try:
            return client.wait(job.id, show)
        except KeyboardInterrupt:
            console.print("cancelling…")
            client.cancel(job.id)
            return client.wait(job.id)

"""Progress bars of uploads and training jobs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

try:
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeElapsedColumn, TransferSpeedColumn
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "Progress bars need Rich: pip install 'lipserve-client[progress]'", name=error.name
    ) from error

from lipserve.records.jobs import Job
from lipserve.states import ACTIVE
from lipserve.wording import percent

if TYPE_CHECKING:  # avoids a circular import
    from lipserve.sync import Client

PLAIN_EVERY = 5.0
"""Time between two lines if the console is not a terminal, s."""


@contextmanager
def job_bar(console: Console | None = None) -> Iterator[Callable[[Job], None]]:
    """Yield a function that shows the progress of a job: as a bar, or without a terminal as lines every five seconds.

    console: default is standard error.
    """
    console = console or Console(stderr=True)
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
            text = text if at.estimator is None else f"{at.estimator}: {text}"
            if at.remaining_s:
                text += f", up to {at.remaining_s:.0f} s left"
            bar.update(task, description=text, completed=at.fraction)
            if not console.is_terminal and (at.elapsed_s - printed >= PLAIN_EVERY or seen.state not in ACTIVE):
                printed = at.elapsed_s
                console.print(f"  {at.elapsed_s:5.1f} s  {percent(at.fraction):>5}  {text}", highlight=False)

        yield show


@contextmanager
def upload_bar(
    text: str, size: int, console: Console | None = None
) -> Iterator[Callable[[Iterator[bytes]], Iterator[bytes]]]:
    """Yield a wrapper of an iterator of bytes that shows how much of `size` bytes has passed.

    After the last piece, the bar says that the service is reading the file.
    """
    console = console or Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(text, total=size)

        def passed(content: Iterator[bytes]) -> Iterator[bytes]:
            for piece in content:
                yield piece
                bar.update(task, advance=len(piece))
            bar.update(task, description=f"{text}: sent, service is reading it")

        yield passed


def follow(client: Client, job: Job, console: Console) -> Job:
    """Show a job's progress until it ends; Ctrl-C cancels it. Return the job as it ended."""
    try:
        with job_bar(console) as show:
            return client.wait(job.id, show)
    except KeyboardInterrupt:
        console.print("cancelling …")
        client.cancel(job.id)
        return client.wait(job.id)

"""`lipserve worker`."""

from __future__ import annotations

import os
from typing import Annotated

import typer

from service.cli.consoles import CommandError
from service.cli.options import alone, settings_of, start_logs
from service.runtime.process import THREAD_VARIABLES

app = alone()


@app.command()
def worker(
    gpus: Annotated[int, typer.Option(min=0, help="Number of GPUs of this worker, for jobs that need one.")] = 0,
    name: Annotated[str | None, typer.Option(help="Name in the cluster. Default: its address.")] = None,
) -> None:
    """Run training jobs and shards of statistics for services that share the cluster LIPSERVE_CLUSTER.

    Set LIPSERVE_DATABASE_URL and LIPSERVE_FILES_URL as for the services. Give each worker its own LIPSERVE_HOME for
    copies of files.
    """
    settings = settings_of()
    if settings.cluster is None:
        raise CommandError("LIPSERVE_CLUSTER is not set", "set it to the address of a scheduler: tcp://host:8786")
    start_logs(settings)
    # numerical libraries read these variables when they are imported
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(settings.training_threads)))
    from service.training import hosting  # noqa: PLC0415

    try:
        hosting.check_storage(settings)
    except hosting.CannotJoinError as error:
        raise CommandError(str(error)) from None
    hosting.join(settings, gpus, name)

"""`lipserve demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lipcore.robots.library import SimulationUnavailableError
from service.cli.consoles import out
from service.cli.demonstration import DemoError, run
from service.client import ApiError

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
ERRORS = (ApiError, DemoError, SimulationUnavailableError)


@app.command()
def demo(
    port: Annotated[int, typer.Option(help="Port of the service; 0 takes a free one.")] = 8000,
    once: Annotated[bool, typer.Option("--once", envvar="ONCE", help="Stop the service at the end.")] = False,
    plot: Annotated[Path | None, typer.Option(help="Also draw measured and predicted torque, .png or .svg.")] = None,
) -> None:
    """Run the main job: serve, simulate a Panda, upload, train, evaluate on unseen trajectories, ask."""
    run(port, once, plot, out)
